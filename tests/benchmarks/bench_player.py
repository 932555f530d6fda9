"""How long a frame of the sweep player takes, from a key to what the browser has drawn.

Run: ``python tests/benchmarks/bench_player.py`` (needs Playwright and Chromium). Frames are RF of 127
vectors by 3818 samples and B-mode of 640 x 480; patches are off, then coloured by correlation, computed for
each frame. Not to be run with real-time priority: browsers wait busily, and then nothing else runs.
"""

import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from browsers import chromium, opened, viewing

from speckle3d.core.sweep import BModeSettings, ImageGrid, RFSettings, Sweep
from speckle3d.io.sweep_writer import write_sweep

FRAMES = 60
RF = RFSettings(66.6667e6, 1540.0, 7.5e6, (5e6, 10e6))

PRESS = """async () => {
  const held = Bokeh.documents[0].get_model_by_name("sweep image")
  const drawn = new Promise((done) => {
    const heard = () => { held.properties.data.change.disconnect(heard); requestAnimationFrame(() => done()) }
    held.properties.data.change.connect(heard)
  })
  const began = performance.now()
  window.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowRight", bubbles: true}))
  await drawn
  return performance.now() - began
}"""


def recordings(folder):
    rng = np.random.default_rng(0)
    rf = rng.normal(0.0, 300.0, (FRAMES, 127, 3818)).astype(np.int16)
    bmode = rng.integers(0, 256, (FRAMES, 640, 480)).astype(np.uint8)
    time_s = np.arange(FRAMES) / 25
    grid = ImageGrid(127, 3818, 0.3, RF.sample_spacing_mm)
    yield "RF 127 x 3818", write(folder / "rf.h5", Sweep(rf, grid, RF, time_s))
    grid = ImageGrid(640, 480, 0.0625, 0.0835)
    yield "B-mode 640 x 480", write(folder / "bmode.h5", Sweep(bmode, grid, BModeSettings(60.0), time_s))


def write(path, sweep):
    write_sweep(path, sweep)
    return path


def measured(page, presses=40):
    return [page.evaluate(PRESS) for _ in range(presses)][3:]


def main():
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        for name, path in recordings(Path(folder)):
            with viewing(path) as address:
                page = opened(browser, address)
                page.get_by_text("frames flagged").wait_for()
                for colouring in ("none", "correlation"):
                    page.get_by_role("button", name=colouring).click()
                    page.keyboard.press("Home")
                    page.wait_for_timeout(1000)
                    took = sorted(measured(page))
                    worst = took[int(0.95 * len(took))]
                    print(
                        f"{name}, patches {colouring}: median {statistics.median(took):.0f} ms, "
                        f"95 % {worst:.0f} ms",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
