"""What error to expect before anyone scans."""

from __future__ import annotations

from typing import Annotated

import typer

from speckle3d.cli.common import Json, app, emit, emit_json, from_options
from speckle3d.cli.helping import App

expect = App(help="What error to expect, before anyone scans.")
app.add_typer(expect, name="expect")


@expect.command("inertial")
def expect_inertial(
    gyroscope_deg_s_rthz: Annotated[
        float | None, typer.Option(help="Noise density of the gyroscope (0.085).")
    ] = None,
    accelerometer_m_s2_rthz: Annotated[
        float | None, typer.Option(help="Noise density of the accelerometer (0.002).")
    ] = None,
    sensor_rate_hz: Annotated[float | None, typer.Option(help="Readings a second (100).")] = None,
    frame_rate_hz: Annotated[float | None, typer.Option(help="Frames a second (25).")] = None,
    lever_mm: Annotated[
        float | None, typer.Option(help="Distance of the sensor above the image's centre (120).")
    ] = None,
    length_mm: Annotated[float | None, typer.Option(help="Length of the sweep (24).")] = None,
    duration_s: Annotated[float | None, typer.Option(help="Duration of the sweep (10).")] = None,
    wobble_mm: Annotated[
        float | None, typer.Option(help="Amplitude of the deliberate to and fro (0.5).")
    ] = None,
    wobble_hz: Annotated[float | None, typer.Option(help="Its frequency (3).")] = None,
    tremor_mm: Annotated[float | None, typer.Option(help="Tremor of the hand (0.012).")] = None,
    as_json: Json = False,
) -> None:
    """Length error to expect of mode `inertial`, for a sensor, a scanner and a motion."""
    from speckle3d.correction.inertial.expected import InertialPlan, expected_scale_error
    from speckle3d.correction.inertial.settings import ASSUMPTION

    plan = from_options(InertialPlan, locals())
    found = expected_scale_error(plan)
    if as_json:
        emit_json({"plan": plan.model_dump(mode="json"), **vars(found), "assumption": ASSUMPTION})
        return
    verdict = "trusted" if found.trusted else "refused: move more" if found.refused else "given as weak"
    emit(f"length: {100 * found.length:.1f} % standard deviation ({verdict})")
    emit(f"lever arm {found.lever_mm:.1f} mm and clock {1e3 * found.clock_s:.1f} ms, found on the way")
    emit(ASSUMPTION)
