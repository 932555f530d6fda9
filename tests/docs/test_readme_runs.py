"""The README's blocks run as written, in order, in an empty folder."""

import pytest
from pages import ROOT, run_page


@pytest.mark.slow
def test_the_readmes_blocks_run_in_order(tmp_path):
    folder = tmp_path / "empty"
    folder.mkdir()
    output = run_page(ROOT / "README.md", folder)
    assert (folder / "volume.nrrd").exists()
    # From the calibrations made on the way to a sweep that knew none: the tracker's length is right.
    rows = [line.split() for line in output.splitlines() if line.startswith("sweep  f")]
    errors = {row[2]: abs(float(row[7])) for row in rows}
    assert errors["pose"] < 3.0
    assert errors["image"] < 25.0
