"""The command `planish` of the wheel: `list` and `doctor` are here, everything else is the program with all stages."""

import subprocess
import sys
import warnings

from . import _EXECUTABLE, PlanishError, programs
from ._plan import pipeline, plan, share

USAGE = """planish run PIPELINE [NAME=VALUE...]   run a pipeline: planish run raster surface=mirror tif=tool machine=m.json
planish show PIPELINE                  its settings, with their defaults and units
planish STAGE --help                   one stage at a time: import, tool, surface, dwell, verify, export and others
planish compare|tolerance|campaign|next-run|resume ...    several runs
planish app                            a page in the browser that plans
planish list                           pipelines, fixture mirrors, machines, planish.m and a notebook, that are here
planish doctor                         system, version, programs, and a plan of a tiny mirror as a check
planish --version                      the version
planish help                           every command
"""


def doctor():
    """Prints what is here, and plans a tiny mirror: 0 if all of it works, else 1 with the remedies."""
    import platform
    import tempfile

    import numpy as np

    def row(name, found):
        print(f"{name:10} {found}")

    remedies = []
    row("system", f"{platform.system()} {platform.machine()}, {' '.join(platform.libc_ver()) or 'no C library known'}")
    row("Python", f"{platform.python_version()}, NumPy {np.__version__}, {sys.executable}")
    try:
        there = sorted(p.name for p in programs().glob("planish-*") if p.suffix in ("", ".exe"))
        row("programs", f"{len(there)} of version {version()} in {programs()}")
    except PlanishError as error:
        row("programs", "missing")
        remedies.append(str(error))
    found = sorted(p.stem for p in (share() / "pipelines").glob("*.yaml") if p.stem != "shared")
    row("pipelines", f"{len(found)} in {share() / 'pipelines'}")
    if not found:
        remedies.append(f"{share() / 'pipelines'} holds no pipelines: pip install the wheel again")
    if not remedies:
        at = np.arange(-6.0, 6.5, 0.5)
        bump = np.exp(-(at[None, :] ** 2 + at[:, None] ** 2) / 8)
        axis = {"max_velocity_mm_per_s": 100, "max_acceleration_mm_per_s2": 1000}
        machine = {"name": "check", "time_to_full_acceleration_s": 0.1, "axes": [{"name": a, **axis} for a in "xy"]}
        try:
            with tempfile.TemporaryDirectory(prefix="planish-") as out, warnings.catch_warnings():
                warnings.simplefilter("ignore")
                made = plan((20 * bump, at, at), (5 * bump, at, at), machine, "raster", out=out, progress=False, pitch_mm=1,
                            plan_joint=False)
                kept = made.summary["methods"][made.method]["limits_respected"]
                row("check", f"{made.height_nm.std():.2f} nm RMS become {made.rms_nm:.2f} nm in {made.time_s:.0f} s")
                if not kept or made.rms_nm >= made.height_nm.std():
                    remedies.append("the check made no good plan: report this as a defect, with what stands above")
        except PlanishError as error:
            row("check", "failed")
            remedies.append(f"{error}\nreport this as a defect, with what stands above")
    for remedy in remedies:
        print(f"error: {remedy}", file=sys.stderr)
    return 1 if remedies else 0


def version():
    """Version of the programs and of this module, which are built together."""
    ran = subprocess.run([programs() / "planish-run", "--version"], capture_output=True, text=True, check=True)
    return ran.stdout.split()[-1]


def whole(*arguments):
    """Command and environment of the program with all stages."""
    _, environment = pipeline()
    del environment["PLANISH_PROGRESS"]
    folder = programs()
    # In the wheel, the name `planish` is that of this script.
    names = [f"planish_programs{_EXECUTABLE}", f"planish{_EXECUTABLE}"]
    file = next(folder / name for name in names if (folder / name).is_file())
    return [str(file), *arguments], environment


def main():
    arguments = sys.argv[1:]
    goal = arguments[0] if arguments else ""
    if goal in ("", "-h", "--help"):
        print(USAGE, end="")
        return 0
    try:
        if goal in ("--version", "-V"):
            print(f"planish {version()}")
            return 0
        if goal == "doctor":
            return doctor()
    except PlanishError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if goal == "list":
        for folder, ending in (("pipelines", ".yaml"), ("fixtures", ".json"), ("fixtures/machines", ".json")):
            found = [p for p in sorted((share() / folder).glob(f"*{ending}")) if p.stem != "shared"]
            # A pipeline takes the name of a fixture, and the path of a machine.
            own_line = folder.endswith("machines")
            print(f"{folder}:" + "".join(f"\n  {p}" if own_line else f" {p.stem}" for p in found))
        for what, file in (("MATLAB and Octave", "planish.m"), ("notebook", "notebook.ipynb")):
            print(f"{what}: {next(share().rglob(file))}")
        print(f"programs (PLANISH_PROGRAMS): {programs()}")
        return 0
    try:
        command, environment = whole(*arguments)
    except PlanishError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return subprocess.run(command, env=environment).returncode


if __name__ == "__main__":
    sys.exit(main())
