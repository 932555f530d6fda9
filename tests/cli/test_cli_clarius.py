"""A Clarius package on the command line: told, converted, and its sensor's orientation found anew."""

import json

import clarius_examples as examples
import numpy as np
from clarius_examples import sweep_of

from speckle3d.io.load import load_sweep


def test_a_package_is_asked_for_what_it_lacks_and_converted(run, refused, tmp_path):
    package = examples.write_package(tmp_path / "x.tar", sweep_of("iq"), packed=True)
    out = tmp_path / "sweep.h5"
    said = refused("convert", package, out)
    assert "--probe" in said
    assert "--bandwidth-hz" in said
    (tmp_path / "import.toml").write_text('probe = "L7 HD3"\nbandwidth_hz = [4e6, 8e6]\n')
    assert run("convert", package, out)[0] == 0
    code, told, _ = run("info", package, "--json")
    assert code == 0
    rows = json.loads(told)
    assert "0.2 mm" in str(rows)
    assert "scalar first, world from sensor" in str(rows)
    plain, made = load_sweep(package), load_sweep(out)
    np.testing.assert_array_equal(made.frames[2], plain.frames[2])
    assert made.signal == plain.signal
