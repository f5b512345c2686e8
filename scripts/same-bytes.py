#!/usr/bin/env python3
"""Compare the results of the pipelines with those of a revision, byte for byte.

same-bytes.py REVISION [--only TEXT]

Every pipeline runs on small fixtures twice: as the revision has it, in a clone under target/same-bytes, and as it
stands here. Printed is the SHA-256 of every `.npy` and of every program for a controller, with the path it has in its
run; then what differs. Manifests, pages and pictures are not compared: their keys and words may change without the
numbers. The exit code is 1 if anything differs, and 2 if a run fails. With --only, those of the runs below that contain
TEXT.
"""

import argparse
import hashlib
import pathlib
import shlex
import shutil
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
WORK = ROOT / "target/same-bytes"
# Output of the runs, in the repository in which they run.
OUT = pathlib.Path("out/same-bytes")
# One run per line: what `just` is called with, without `out=`. Together they reach every stage, every kind of path,
# every solver, every scheduler, every controller, and the settings that change the mathematics.
RUNS = """
run raster fixture=coupon export=galil
run raster fixture=coupon pitch_mm=0.5 step_mm=0.5 min_dwell_s_per_mm=0.05
run raster fixture=coupon mode=smooth export=pmac
run raster fixture=coupon-noise refine=no export=gcode prepare="--mask-outliers --feature-mm 4 --fill"
run raster fixture=coupon machine=fixtures/machines/fluid-jet.json export=xps
run raster fixture=coupon-ring export=csv frames=0 prepare="--level zernike --level-order 4"
run maze fixture=coupon corner_radius_mm=0.5 tree=wilson
run maze fixture=coupon-mixture
run random-adaptive fixture=coupon
run spiral fixture=coupon
run multi-pitch fixture=coupon classes=3 max_velocity_mm_per_s=5
run trig-spline fixture=coupon
run bspline fixture=coupon machine=fixtures/machines/ion-beam-no-jerk-limit.json pitch_mm=1 step_mm=0.5
compare-dwell coupon
compare coupon
"""


def run(command, **others):
    """Runs a command, which must end with 0; what it printed."""
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **others)
    if done.returncode != 0:
        sys.stderr.write(done.stdout)
        failed(f"{shlex.join(map(str, command))} ended with {done.returncode}")
    return done.stdout.strip()


def failed(message):
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


def hashes(repository, runs):
    """Runs the pipelines of a repository: a line for every file, with its hash and its path."""
    shutil.rmtree(repository / OUT, ignore_errors=True)
    run(["just", "build"], cwd=repository)
    for number, words in runs:
        command = ["just", *words, f"out={OUT / str(number)}"]
        done = subprocess.run(
            command, cwd=repository, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        # 1 is a negative verdict, and as such a result.
        if done.returncode not in (0, 1):
            sys.stderr.write(done.stdout)
            failed(f"{shlex.join(command)} ended with {done.returncode} in {repository}")
    lines = []
    for path in (repository / OUT).rglob("*"):
        is_program = path.name.startswith("program.") and path.suffix != ".json"
        if path.is_file() and (path.suffix == ".npy" or is_program):
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            lines.append((f"./{path.relative_to(repository / OUT)}", digest))
    if not lines:
        failed(f"the runs in {repository} left no file to compare")
    return sorted(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", help="revision to compare with")
    parser.add_argument("--only", default="", metavar="TEXT", help="only the runs that contain this text")
    asked = parser.parse_args()
    lines = enumerate(RUNS.strip().splitlines(), start=1)
    runs = [(number, shlex.split(line)) for number, line in lines if asked.only in line]
    if not runs:
        failed(f"no run contains {asked.only!r}")
    clone = WORK / "revision"
    WORK.mkdir(parents=True, exist_ok=True)
    commit = run(["git", "-C", ROOT, "rev-parse", "--verify", "--end-of-options", f"{asked.revision}^{{commit}}"])
    if not clone.is_dir():
        run(["git", "clone", "--quiet", "--no-checkout", ROOT, clone])
    run(["git", "-C", clone, "fetch", "--quiet", "origin"])
    run(["git", "-C", clone, "checkout", "--quiet", "--detach", commit])
    before, after = hashes(clone, runs), hashes(ROOT, runs)
    for path, digest in after:
        print(f"{digest}  {path}")
    if before == after:
        print(f"the same {len(after)} files as at {asked.revision}")
        return 0
    for sign, own, other in (("<", before, after), (">", after, before)):
        for path, digest in sorted(set(own) - set(other)):
            print(f"{sign} {digest}  {path}")
    print(f"different from {asked.revision}: the lines above, < there and > here")
    return 1


if __name__ == "__main__":
    sys.exit(main())
