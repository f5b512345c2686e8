"""Makes the measured parts of the benchmark from files that are not part of the project.

  python3 benchmark/measured.py FOLDER          parts into out/benchmark, from the data in FOLDER

FOLDER has `nsls2-mirror` (T. Wang et al. 2023, doi 10.1016/j.jmapro.2023.01.005, with the measured tool),
`instruments/initial_map.mat` (the map of the pvt-scheduler), and `dabam` (lines of X-ray mirrors: M. Sanchez del Rio et
al., J. Synchrotron Rad. 23 (2016) 665, the DABAM data base). The tools of the map and of the lines are Gaussians.
"""

import json
import shutil
import struct
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "out/benchmark"
# Lines with slopes at every mm or finer, over more than twice the wider tool.
LINES = "009 023 027 029 031 033 035 037 039 041 051 053 059 079 081 085 087 097 099 101".split()
# Standard deviations of the tools of the lines, mm.
LINE_TOOLS = [2.5, 5.0]
# Unit and sign of the slopes of a line: the files state no sign.
SIGN = "--value-unit urad --positive hill"
# Part of a line that is its strip across, mm.
STRIP_MM = 8
# Standard deviations of the tools of the map, mm.
MAP_TOOLS = [2.0, 5.0]


def planish(*words):
    program = ROOT / "target/release/planish"
    subprocess.run([program, *map(str, words), "--force"], check=True, stdout=subprocess.DEVNULL)


def gaussian(name, pitch_mm, sigma_mm, peak_nm_per_s):
    """Writes the tool as the one of a fixture with pixels of this pitch, and returns its folder."""
    recipe = {
        "name": name,
        "doc": "A tool.",
        "seed": 1,
        "pixels": [11, 11],
        "width_mm": 10 * pitch_mm,
        "aperture": "rectangle",
        "legendre": [{"order": [2, 0], "amplitude_nm": 1.0}],
        "tif": {
            "peak_nm_per_s": peak_nm_per_s,
            "half_size_mm": 3.5 * sigma_mm,
            "shape": {"gaussian": {"sigma_mm": sigma_mm}},
        },
    }
    file = OUT / f"{name}.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(recipe))
    planish("fixture", file, "--out", OUT / f"{name}-tool")
    return OUT / f"{name}-tool/tif"


def copy(source, out, names):
    """Copies arrays to an artifact directory under the names that it has there."""
    out.mkdir(parents=True, exist_ok=True)
    for there, here in names.items():
        shutil.copyfile(source / f"{there}.npy", out / f"{here}.npy")


def coordinates(file):
    """Returns the numbers of a one-dimensional array of doubles in NumPy's format."""
    content = file.read_bytes()
    start = 10 + struct.unpack("<H", content[8:10])[0]
    return struct.unpack(f"<{(len(content) - start) // 8}d", content[start:])


def mirror(folder):
    source, out = folder / "nsls2-mirror", OUT / "reference-mirror"
    axes = {"x_mm": "x_mm", "y_mm": "y_mm"}
    copy(source, out / "surface", {"height_nm": "height_nm", **axes})
    tif = {"tif_nm_per_s": "rate_nm_per_s", "tif_x_mm": "x_mm", "tif_y_mm": "y_mm"}
    copy(source, out / "tif", tif)


def initial_map(folder):
    raw = OUT / "initial-map"
    units = "--unit m --coordinate-unit m".split()
    planish("import", "surface", folder / "instruments/initial_map.mat", *units, "--out", raw)
    x_mm = coordinates(raw / "x_mm.npy")
    for sigma_mm in MAP_TOOLS:
        out = OUT / f"initial-map-sigma-{sigma_mm:g}"
        planish("surface", "prepare", "--surface", raw, "--level", "piston", "--out", out / "surface")
        tool = gaussian(out.name, (x_mm[-1] - x_mm[0]) / (len(x_mm) - 1), sigma_mm, 20.0)
        copy(tool, out / "tif", {name: name for name in ("rate_nm_per_s", "x_mm", "y_mm")})


def lines(folder):
    tools = {sigma: gaussian(f"line-sigma-{sigma:g}", 0.5, sigma, 5.0) for sigma in LINE_TOOLS}
    for number in LINES:
        about = json.loads((folder / f"dabam/dabam-{number}.txt").read_text())
        profile = OUT / f"dabam-{number}.csv"
        rows = (folder / f"dabam/dabam-{number}.dat").read_text(errors="replace").splitlines()
        with profile.open("w") as file:
            for row in rows[about["FILE_HEADER_LINES"] :]:
                words = row.replace(",", " ").split()
                if len(words) >= 2:
                    x_mm = float(words[0]) * about["X1_FACTOR"] * 1e3
                    urad = float(words[1]) * about["Y1_FACTOR"] * 1e6
                    file.write(f"{x_mm:.6f},{urad:.6f}\n")
        for sigma_mm, tool in tools.items():
            out = OUT / f"dabam-{number}-sigma-{sigma_mm:g}"
            shape = ["--subtract", "cylinder-x", "--strip-width-mm", STRIP_MM]
            planish("surface", "line", "--profile", profile, *SIGN.split(), "--tif", tool, *shape, "--out", out)
            # What `planish run line` needs.
            settings = {
                "profile": str(profile),
                "profile_settings": SIGN,
                "tif": str(tool),
                "subtract": "cylinder-x",
                "strip_width_mm": str(STRIP_MM),
            }
            (out / "line.json").write_text(json.dumps(settings, indent=2))
            (out / "about.json").write_text(json.dumps(statements(about)))


def statements(about):
    """Returns what the file of a line says of the mirror: its laboratory, its year and the RMS of its slopes, nrad."""
    slopes = about.get("CALC_SLOPE_RMS")
    return {
        "laboratory": about.get("FACILITY") or "",
        "year": about.get("YEAR_FABRICATION") or "",
        "slopes_nrad": slopes and 1e9 * slopes * about["CALC_SLOPE_RMS_FACTOR"],
    }


def main(folder):
    OUT.mkdir(parents=True, exist_ok=True)
    mirror(folder)
    initial_map(folder)
    lines(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
