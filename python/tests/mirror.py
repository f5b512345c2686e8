"""A mirror of 150 x 40 mm made with NumPy, and a machine whose axes are exchanged and displaced.

    python3 mirror.py write            mirror/, tool/ and machine.json, as README.md says
    python3 mirror.py check PLAN PROGRAM...    whether the programs start where the plan does, in the machine's own axes
"""

import json
import pathlib
import sys

import numpy as np

MACHINE = {
    "name": "lab",
    "part_origin_mm": [60.0, 100.0],
    "axes": [
        {"name": "x", "max_velocity_mm_per_s": 250, "max_acceleration_mm_per_s2": 2000, "travel_mm": [0, 120],
         "along": "+y"},
        {"name": "y", "max_velocity_mm_per_s": 200, "max_acceleration_mm_per_s2": 2000, "travel_mm": [0, 200],
         "along": "-x"},
    ],
}


def arrays():
    """Height in nm: two bumps and a wave; and the rate of a tool of 5 nm/s and 2.5 mm standard deviation."""
    x, y = np.arange(-75, 75.25, 0.5), np.arange(-20, 20.25, 0.5)
    bump = lambda at, width: np.exp(-((x[None, :] - at) ** 2 + (y[:, None] - 0.2 * at) ** 2) / (2 * width**2))
    height = 60 * bump(-30, 12) + 45 * bump(35, 16) + 4 * np.cos(2 * np.pi * x / 50)[None, :] + 20
    d = np.arange(-8, 8.25, 0.5)
    rate = 5 * np.exp(-(d[None, :] ** 2 + d[:, None] ** 2) / (2 * 2.5**2))
    return {"height_nm": height, "x_mm": x, "y_mm": y}, {"rate_nm_per_s": rate, "x_mm": d, "y_mm": d}


def write():
    for folder, of in zip(("mirror", "tool"), arrays()):
        pathlib.Path(folder).mkdir()
        for name, array in of.items():
            np.save(f"{folder}/{name}.npy", array)
    pathlib.Path("machine.json").write_text(json.dumps(MACHINE))


def check(plan, programs):
    """The first point of a program is that of the plan: the x axis of the machine goes along +y of the part, its y axis
    along -x, and the part's origin lies at (60, 100) mm."""
    first = np.load(f"{plan}/coefficient_mm.npy")[0, :, 0]
    for program in programs:
        start = json.loads(pathlib.Path(f"{program}.json").read_text())["start_mm"]
        expected = [60 + first[1], 100 - first[0]]
        # Counts of 0.1 um.
        assert np.allclose(start, expected, atol=1e-4), (program, start, expected)
        print(f"{program}: starts at x {start[0]:.4f}, y {start[1]:.4f} mm of the machine")


if __name__ == "__main__":
    write() if sys.argv[1] == "write" else check(sys.argv[2], sys.argv[3:])
