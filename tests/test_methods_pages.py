"""The pages of methods name what is there: settings with their defaults, modules, limits and sources."""

import re
from pathlib import Path

import pytest

from speckle3d.config import Config

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs" / "methods").glob("*.md"))
SETTINGS = Config().model_dump()

named_page = pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])


def settings_in(text):
    """Group and name of each setting in a page, and the number in parentheses behind it, if any."""
    mentions = re.findall(
        r"([a-z]+)\.([a-z_]+)\b(?:`|\})(?:\s(?:\(|\| )([-\d.]+)(?=[\s),;]))?", text.replace("\\_", "_")
    )
    return [
        (group, name, value)
        for group, name, value in mentions
        if group in SETTINGS and name not in ("md", "png", "py")
    ]


@named_page
def test_settings_of_a_page_exist_with_the_defaults_it_gives(page):
    for group, name, value in settings_in(page.read_text()):
        assert name in SETTINGS[group], f"{page.name}: {group}.{name}"
        default = SETTINGS[group][name]
        if value and isinstance(default, (int, float)):
            number = pytest.approx(float(value))
            assert number in (default, 100 * default), f"{page.name}: {group}.{name}"


@named_page
def test_modules_that_a_page_names_exist(page):
    text = page.read_text()
    for path in re.findall(r"`((?:speckle3d|calibration|xsens)/[\w/]+(?:\.py)?)`", text):
        assert (ROOT / path).exists(), f"{page.name}: {path}"
