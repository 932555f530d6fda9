"""Configurations of older versions."""

import pytest

from speckle3d.config import REMOVED_SETTINGS, Config, config_from_toml, stored_config
from speckle3d.core.errors import InvalidInputError


@pytest.mark.parametrize("name", REMOVED_SETTINGS)
def test_a_removed_setting_is_refused_with_what_is_there_instead_and_read_from_old_files(name):
    stage, _, setting = name.partition(".")
    text = f"[{stage}]\n{setting or 'anything'} = 1\n[planes]\nhuber = 3.0\n"
    with pytest.raises(InvalidInputError) as error:
        config_from_toml(text, "mine.toml")
    assert str(error.value).startswith(f"mine.toml: {name} was removed: {REMOVED_SETTINGS[name]}")
    assert stored_config(text) == Config(planes={"huber": 3.0})
