"""Tools of 16, 8 and 4 mm for the measured map of 60 x 60 mm in PLANISH_REFERENCE, together and each alone: the table of
docs/several-tools.md, with the time of the solver beside each plan. The files go to out/tools-table."""

import json
import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "out/tools-table"
MAP = Path(os.environ["PLANISH_REFERENCE"]) / "instruments/initial_map.mat"
PRICE_NM2_PER_S = 0.003
RATE_NM_PER_S = 20.0
# The width of a Gaussian at half its peak, over its sigma.
WIDTH_PER_SIGMA = 2.3548


def planish(*words):
    """Runs a command of Planish. Returns what it prints."""
    command = [str(ROOT / "target/release/planish"), *map(str, words)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def make_tool(width_mm):
    """Makes the TIF of a Gaussian tool and its raster, with lines and points a quarter of its width apart."""
    recipe = {
        "name": f"tool-{width_mm}",
        "doc": "A Gaussian tool.",
        "seed": 1,
        "pixels": [21, 21],
        "width_mm": 20.0,
        "aperture": "rectangle",
        "legendre": [{"order": [2, 0], "amplitude_nm": 1.0}],
        "noise_rms_nm": 0.0,
        "tif": {
            "peak_nm_per_s": RATE_NM_PER_S,
            "half_size_mm": 1.5 * width_mm,
            "shape": {"gaussian": {"sigma_mm": width_mm / WIDTH_PER_SIGMA}},
        },
    }
    file = OUT / f"tool-{width_mm}.json"
    file.write_text(json.dumps(recipe))
    planish("fixture", file, "--out", OUT / f"tool-{width_mm}", "--force")
    pitch_mm = width_mm / 4
    planish("toolpath", "raster", "--surface", OUT / "surface", "--tif", OUT / f"tool-{width_mm}/tif",
            f"--pitch-mm={pitch_mm}", f"--step-mm={pitch_mm}", "--out", OUT / f"path-{width_mm}", "--force")


def plan(widths_mm):
    """Plans with these tools. Returns the report of the plan, its number of columns and the time of the solver, s."""
    name = "-".join(map(str, widths_mm))
    tools = [{"name": f"tool-{mm}", "tif": f"tool-{mm}/tif", "tool_path": f"path-{mm}",
              "time_weight_nm2_per_s": PRICE_NM2_PER_S} for mm in widths_mm]
    (OUT / f"rack-{name}.json").write_text(json.dumps({"tools": tools}))
    planish("dwell", "several-tools", "--surface", OUT / "surface", "--rack", OUT / f"rack-{name}.json",
            "--out", OUT / f"plan-{name}", "--wall-time", OUT / f"time-{name}.json", "--force")
    manifest = json.loads((OUT / f"plan-{name}/tool-{widths_mm[0]}/manifest.json").read_text())
    report = manifest["outcome"]["report"]
    wall_s = json.loads((OUT / f"time-{name}.json").read_text())["wall_s"]
    return report, sum(tool["points"] for tool in report["tools"]), wall_s


def main():
    """Prints the table."""
    OUT.mkdir(parents=True, exist_ok=True)
    planish("import", "surface", MAP, "--unit", "m", "--coordinate-unit", "m", "--out", OUT / "imported", "--force")
    planish("surface", "prepare", "--surface", OUT / "imported", "--level", "piston", "--out", OUT / "surface",
            "--force")
    for width_mm in [16, 8, 4]:
        make_tool(width_mm)
    print("tools mm     columns    RMS nm     total s      gap   solver s")
    for widths_mm in [[16], [8], [4], [16, 4], [16, 8, 4]]:
        report, columns, wall_s = plan(widths_mm)
        print(f"{' + '.join(map(str, widths_mm)):<12} {columns:>7} {report['model_rms_nm']:>9.4f}"
              f" {report['total_time_s']:>11.1f} {report['relative_gap']:>8.1e} {wall_s:>10.1f}", flush=True)


if __name__ == "__main__":
    main()
