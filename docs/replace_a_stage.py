"""A dwell solver in NumPy, in the place of `planish-dwell`.

    python3 docs/replace_a_stage.py RUN_DIR OUT_DIR

reads RUN_DIR/surface and RUN_DIR/tool_path, writes OUT_DIR/dwell_s.npy. A directory with the
right arrays is an artifact; no manifest is needed.

The method is the oldest one: the dwell time at a point is proportional to the desired removal
there.
"""

import sys
from pathlib import Path

import numpy as np

run, out = Path(sys.argv[1]), Path(sys.argv[2])

height_nm = np.load(run / "surface" / "height_nm.npy")  # (ny, nx), NaN where invalid
x_mm = np.load(run / "surface" / "x_mm.npy")
y_mm = np.load(run / "surface" / "y_mm.npy")
point_mm = np.load(run / "tool_path" / "dwell_point_mm.npy")  # (n, 2)

column = np.abs(x_mm[None, :] - point_mm[:, :1]).argmin(axis=1)
row = np.abs(y_mm[None, :] - point_mm[:, 1:]).argmin(axis=1)
dwell_s = 0.1 + 0.02 * np.nan_to_num(height_nm[row, column])

out.mkdir(parents=True, exist_ok=True)
np.save(out / "dwell_s.npy", dwell_s.astype("<f8"))
print(f"{len(dwell_s)} dwell times, {dwell_s.sum():.1f} s -> {out}")
