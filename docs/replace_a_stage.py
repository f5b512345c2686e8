"""A dwell solver in NumPy, in the place of `planish dwell`.

    python3 docs/replace_a_stage.py SURFACE TIF TOOL_PATH OUT

reads the three directories, writes OUT/dwell_s.npy. A directory with the right arrays is an artifact;
no manifest is needed.

The method is that of Lucy and Richardson: the removal at the dwell points is R t, where R_ij is the
rate at point i of the tool at point j. Each round multiplies the dwell times t by how far the removal
that they make falls short of the desired one, h / (R t), as the tool at each point sees it. So they
stay positive; 0.1 s, the least dwell time, is added everywhere and removes a constant.
"""

import sys
from pathlib import Path

import numpy as np

surface, tif, tool_path, out = map(Path, sys.argv[1:])
height_nm, x_mm, y_mm = (np.load(surface / f"{name}.npy") for name in ("height_nm", "x_mm", "y_mm"))
tif_nm_per_s, dx_mm, dy_mm = (np.load(tif / f"{name}.npy") for name in ("rate_nm_per_s", "x_mm", "y_mm"))
point_mm = np.load(tool_path / "dwell_point_mm.npy")  # (n, 2)


def at(values, x, y, points):
    """The values (ny, nx) at the nearest samples to the points (..., 2), NaN beyond the samples."""
    column = np.rint((points[..., 0] - x[0]) / (x[1] - x[0])).astype(int)
    row = np.rint((points[..., 1] - y[0]) / (y[1] - y[0])).astype(int)
    inside = (column >= 0) & (column < len(x)) & (row >= 0) & (row < len(y))
    return np.where(inside, values[np.where(inside, row, 0), np.where(inside, column, 0)], np.nan)


height = at(height_nm, x_mm, y_mm, point_mm)
valid = np.isfinite(height)  # the path goes beyond the map
# Any constant may be removed beside the error: all but the deepest pits become positive.
desired_nm = np.maximum(height[valid] - np.percentile(height[valid], 1), 0.01)
offset_mm = point_mm[valid, None] - point_mm[None]  # pixel - tool
rate = np.nan_to_num(at(tif_nm_per_s, dx_mm, dy_mm, offset_mm))

extra_s = np.full(len(point_mm), desired_nm.mean() / rate.sum(axis=1).mean())
for _ in range(50):
    short = desired_nm / (rate @ extra_s)
    extra_s *= rate.T @ short / np.maximum(rate.sum(axis=0), 1e-12)
dwell_s = 0.1 + extra_s

out.mkdir(parents=True, exist_ok=True)
np.save(out / "dwell_s.npy", dwell_s)
print(f"{len(dwell_s)} dwell times, {dwell_s.sum():.1f} s -> {out}")
