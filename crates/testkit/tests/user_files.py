"""What a user would have who follows README.md and docs/: files of instruments, a map and a TIF as arrays.

    python3 user_files.py FIXTURE_DIR

makes them in the current directory out of a fixture's surface and tif: `mirror.datx`, `spot.mat`,
`rates.mat`, `depth.datx`, `before.datx`, `after.datx`, the map `measured` with its `asphere.json`, slopes in `slopes.mat`, `sx.npy` and `sy.npy`, and the lines of a profiler `scan.csv`, `scan.npy`. A reader goes by the content and not by the name:
what is called .datx here is FITS, which takes four lines to write and states its units as datx does.
"""

import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "import/tests"))
from writers import write_mat as mat  # noqa: E402


def fits(path, height_nm, pitch_mm):
    """A map in nm whose first row is the smallest y."""
    ny, nx = height_nm.shape
    cards = ["SIMPLE  = T", "BITPIX  = -64", "NAXIS   = 2", f"NAXIS1  = {nx}", f"NAXIS2  = {ny}", "BUNIT   = 'nm'",
             f"CDELT1  = {pitch_mm!r}", f"CDELT2  = {pitch_mm!r}", "CUNIT1  = 'mm'", "CUNIT2  = 'mm'", "END"]
    head = "".join(f"{card:<80}" for card in cards).encode()
    data = np.ascontiguousarray(height_nm, ">f8").tobytes()
    Path(path).write_bytes(head.ljust(-len(head) // 2880 * -2880) + data.ljust(-len(data) // 2880 * -2880, b"\0"))


fixture = Path(sys.argv[1])
height_nm, x_mm = (np.load(fixture / "surface" / f"{name}.npy") for name in ("height_nm", "x_mm"))
rate_nm_per_s, dx_mm, dy_mm = (np.load(fixture / "tif" / f"{name}.npy") for name in ("rate_nm_per_s", "x_mm", "y_mm"))

fits("mirror.datx", height_nm, float(x_mm[1] - x_mm[0]))
x, y = np.meshgrid(dx_mm / 1e3, dy_mm / 1e3)
for name in ("spot.mat", "rates.mat"):
    mat(name, Xtif=x, Ytif=y, Ztif=rate_nm_per_s / 1e9)

# The same error on an asphere of 250.3 mm, as docs/forms.md has it.
asphere = {"kind": "asphere", "radius_mm": 250.0, "conic_constant": -0.9, "even_terms": [1e-8], "vertex_mm": [10, 6],
           "fit": {"radius_mm": [249.0, 251.0], "conic_constant": "free"}}
Path("asphere.json").write_text(json.dumps(asphere))
y_mm = np.load(fixture / "surface" / "y_mm.npy")
r2_mm2 = (x_mm[None] - 10) ** 2 + (y_mm[:, None] - 6) ** 2
sag_mm = r2_mm2 / 250.3 / (1 + np.sqrt(1 - 0.1 * r2_mm2 / 250.3**2)) + 1e-8 * r2_mm2**2
Path("measured").mkdir()
for name, values in (("height_nm", height_nm + 1e6 * sag_mm), ("x_mm", x_mm), ("y_mm", y_mm)):
    np.save(f"measured/{name}.npy", values)

# A test piece of 25 mm, with a spot of 30 s; measured again with a shift of a tenth of a pixel.
axis_mm = np.arange(-50, 51) * 0.25
r2_mm2 = axis_mm[:, None] ** 2 + axis_mm[None] ** 2
spot_nm = 300 * np.exp(-r2_mm2 / 2)


def piece_nm(shift_mm):
    return 20 * np.sin((axis_mm[:, None] - shift_mm) / 2) * np.cos((axis_mm[None] - shift_mm) / 3)


fits("depth.datx", spot_nm, 0.25)
fits("before.datx", piece_nm(0), 0.25)
fits("after.datx", piece_nm(0.025) - spot_nm, 0.25)

# Slopes of a test piece along x and y, nm/mm = urad, in one file and in two.
def slopes_urad():
    x, y = axis_mm[None], axis_mm[:, None]
    return (
        20 / 3 * np.cos(x / 3 + y / 5) * np.cos(y / 2),
        20 * (np.cos(x / 3 + y / 5) * np.cos(y / 2) / 5 - np.sin(x / 3 + y / 5) * np.sin(y / 2) / 2),
    )


mat("slopes.mat", slope_x=slopes_urad()[0], slope_y=slopes_urad()[1])
for name, slope_urad in zip(("sx.npy", "sy.npy"), slopes_urad()):
    np.save(name, slope_urad)

# A line of a profiler: slopes of a cylinder of 2 km with a ripple, in urad over mm; and of an ellipse of p 30 m,
# q 0.4 m, 3 mrad in its leading orders, in rad over m.
at_mm = np.arange(-50, 50.5, 0.5)
slope_urad = at_mm / 2 + 0.2 * np.sin(2 * np.pi * at_mm / 8)
np.savetxt("scan.csv", np.c_[at_mm, slope_urad], delimiter=",", header="position (mm), slope (urad)")
curvature_per_mm = 3e-3 / 2 * (1 / 30000 + 1 / 400)
np.save("scan.npy", np.c_[at_mm / 1e3, curvature_per_mm * at_mm])

# Four fiducials at the corners of 92 x 16 mm, turned by 0.2 degree and moved, read to 5 um.
angle = np.radians(0.2)
corners_mm = np.array([[0, 0], [92, 0], [92, 16], [0, 16]])
turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
read_mm = corners_mm @ turn.T + [150, 40] + 1e-3 * np.array([[3, -2], [-4, 1], [2, 5], [-1, -3]])
np.savetxt(
    "fiducials.csv",
    np.c_[corners_mm, read_mm, np.full(4, 5e-3)],
    delimiter=",",
    comments="",
    header="map_x_mm,map_y_mm,machine_x_mm,machine_y_mm,uncertainty_mm",
)

# A rate that falls by a tenth in the first 100 s, as docs/varying.md has it.
Path("warm-up.txt").write_text("0 1\n100 0.9\n")
