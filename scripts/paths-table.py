"""The tables of docs/paths.md and docs/joint-paths.csv: every path on the reference mirror, at about the published number of
dwell points (2678). Least dwell time 0.1 s, unrefined and refined, and motion and times as one problem
(`just paths-table [MACHINE]`).
"""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Name, pipeline and its settings; the paths share 5 mm of overscan.
PATHS = [
    ("raster", "raster", {}),
    ("raster-angle", "raster", {"scan": "30"}),
    ("raster-one-direction", "raster", {"variant": "--one-directional"}),
    ("raster-bi-step", "raster", {"variant": "--line-order bi-step"}),
    ("raster-random", "raster", {"variant": "--line-order random"}),
    ("raster-adaptive", "raster", {"variant": "--pitch-range-mm 0.7 1.4"}),
    ("maze", "maze", {}),
    ("mesh-tree", "random-adaptive", {"pitch_mm": "1.13"}),
    ("tour", "random-adaptive", {"pitch_mm": "1.17", "construction": "tour", "rounding_passes": "0"}),
    ("multi-pitch", "multi-pitch",
     {"max_velocity_mm_per_s": "6", "step_mm": "1", "max_pitch_mm": "1.6", "min_dwell_s_per_mm": ""}),
]
MOTIONS = ["pvt", "pvt+refined", "joint"]


def mirror(out):
    """The settings of a run on the mirror: its map and its TIF as artifacts without manifests."""
    if "PLANISH_REFERENCE" not in os.environ:
        sys.exit("PLANISH_REFERENCE: name the folder that holds nsls2-mirror/")
    subprocess.run(["just", "reference-mirror", out], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return {"surface": out / "surface", "tif": out / "tif", "overscan_mm": "5", "plan_joint": "yes"}


def run(pipeline, settings):
    command = [ROOT / "target/release/planish-run", "run", pipeline, *(f"{k}={v}" for k, v in settings.items())]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    # A plan that is not proven to be the best ends with 1 and its verdict, and is in the table all the same.
    if done.returncode not in (0, 1) or "verdict: " not in done.stdout + done.stderr and done.returncode == 1:
        sys.exit(f"{' '.join(map(str, command))}:\n{done.stdout}{done.stderr}")


def main():
    machine = Path(sys.argv[1]).resolve()
    out = ROOT / "out/paths-table" / machine.stem
    shared = {**mirror(out), "machine": machine}
    print("| path | points | motion | raw RMS, nm | total time, s | largest acceleration x, y, mm/s^2 |")
    print("|---|---|---|---|---|---|")
    for name, pipeline, settings in PATHS:
        run(pipeline, {**shared, "out": out / name, **settings})
        points = json.loads((out / name / "tool_path/manifest.json").read_text())["outcome"]["points"]
        methods = json.loads((out / name / "report/summary.json").read_text())["methods"]
        for motion in MOTIONS:
            m = methods[motion]
            largest = ", ".join(f"{a:.0f}" for a in m["max_acceleration_mm_per_s2"])
            print(f"| {name} | {points} | {motion} | {m['rms_nm']:.4f} | {m['total_time_s']:.1f} | {largest} |", flush=True)


if __name__ == "__main__":
    main()
