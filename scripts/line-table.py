"""The table of docs/lines.csv: slope errors of five mirror lines before and after their plans, without and with a weight
of the slope of the residual (`just line-table`).

The residuals are computed here, from the profile, the samples of the tool and the coefficients of the motion, and by
none of the programs. The tool is interpolated by cubic polynomials through four samples and integrated across the strip
by Simpson's rule. The motion is integrated by the midpoint rule.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
LINES = [250, 500, 1000, 1500, 2000]
# Weights of the slope, mm^2: none, and one that counts a wave of 20 mm 11 times.
WEIGHTS = ["", "100"]
WIDTH_MM = 8.0


def array(directory, name):
    return np.load(directory / f"{name}.npy")


def between(samples, start, step, at):
    """Cubic polynomials through four samples along the last axis, zero beyond the samples."""
    n = samples.shape[-1]
    s = (at - start) / step
    i = np.clip(np.floor(s).astype(int) - 1, 0, n - 4)
    u = s - i
    weights = [
        -(u - 1) * (u - 2) * (u - 3) / 6,
        u * (u - 2) * (u - 3) / 2,
        -u * (u - 1) * (u - 3) / 2,
        u * (u - 1) * (u - 2) / 6,
    ]
    value = sum(w * samples[..., i + k] for k, w in enumerate(weights))
    return np.where((s >= -1e-9) & (s <= n - 1 + 1e-9), value, 0.0)


def across(tif, width_mm):
    """Mean of the rate over the strip (nm/s) at the samples along x."""
    rate, y = array(tif, "rate_nm_per_s"), array(tif, "y_mm")
    at = np.linspace(-width_mm / 2, width_mm / 2, 401)
    simpson = np.ones(401)
    simpson[1:-1:2], simpson[2:-1:2] = 4, 2
    rows = between(rate.T, y[0], y[1] - y[0], at)
    return rows @ simpson / simpson.sum()


def removal(trajectory, tif, x, width_mm):
    """Mean removal across the strip (nm) at x."""
    rate, tif_x = across(tif, width_mm), array(tif, "x_mm")
    breaks, coefficients = array(trajectory, "break_time_s"), array(trajectory, "coefficient_mm")
    on = array(trajectory, "tool_on")
    total = np.zeros_like(x)
    parts = 20
    for k in np.flatnonzero(on):
        duration = breaks[k + 1] - breaks[k]
        u = (np.arange(parts) + 0.5) * duration / parts
        for c, name in ((coefficients[k, 1], "y"),):
            assert np.all(np.abs(np.polyval(c[::-1], u)) < 1e-6), f"the tool leaves the line ({name})"
        places = np.polyval(coefficients[k, 0][::-1], u)
        near = slice(*np.searchsorted(x, [places.min() + tif_x[0] - 1, places.max() + tif_x[-1] + 1]))
        offsets = x[near, None] - places
        total[near] += between(rate, tif_x[0], tif_x[1] - tif_x[0], offsets).sum(axis=1) * duration / parts
    return total


def slope_rms(height, x):
    """RMS of the slopes between neighbours without their mean, nrad."""
    return 1e3 * np.std(np.diff(height) / np.diff(x))


def plan(line, weight, out):
    command = [
        ROOT / "target/release/planish-run",
        "run",
        "line",
        f"fixture=lines/line-{line}",
        f"residual_slope_weight_mm2={weight}",
        f"strip_width_mm={WIDTH_MM}",
        "frames=0",
        f"out={out}",
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode not in (0, 1):
        sys.exit(f"{' '.join(map(str, command))}:\n{done.stdout}{done.stderr}")


def main():
    out = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "out/lines").resolve()
    print("| line | slopes before, nrad | heights alone: slopes, nrad | heights, nm | time, min "
          "| with slopes: slopes, nrad | heights, nm | time, min | slopes less |")
    print("|---|---|---|---|---|---|---|---|---|")
    bad = []
    for line in LINES:
        cells, left = [], []
        for weight in WEIGHTS:
            run = out / f"line-{line}-{weight or 'none'}"
            plan(line, weight, run)
            surface = run / "fixture/surface"
            x, height = array(surface, "x_mm"), array(surface, "height_nm").mean(axis=0)
            # The plan is for the profile without its line.
            height = height - np.polyval(np.polyfit(x, height, 1), x)
            before = slope_rms(height, x)
            trajectory = run / "methods/pvt+refined/trajectory"
            residual = height - removal(trajectory, run / "fixture/tif", x, WIDTH_MM)
            after = slope_rms(residual, x)
            left.append(after)
            minutes = array(trajectory, "break_time_s")[-1] / 60
            cells += [f"{after:.1f}", f"{np.std(residual):.3f}", f"{minutes:.1f}"]
            if after > before / 5:
                bad.append(f"line-{line} with the weight '{weight}' keeps {after:.1f} of {before:.1f} nrad")
        if left[1] >= left[0]:
            bad.append(f"line-{line}: the weight does not lower the slopes: {left[0]:.1f}, {left[1]:.1f} nrad")
        print(f"| `line-{line}` | {before:.0f} | " + " | ".join(cells) + f" | {100 * (1 - left[1] / left[0]):.0f} % |")
    if bad:
        sys.exit("\n".join(bad))


if __name__ == "__main__":
    main()
