import pytest


@pytest.fixture
def sensor(tmp_path, request):
    """A simulated sensor of the kind that the test is parametrised with, an MT9-B by default."""
    from simulated_device import SimulatedDevice  # not everywhere are there pseudo-terminals

    with SimulatedDevice(tmp_path / "port", **getattr(request, "param", {})) as device:
        yield device
