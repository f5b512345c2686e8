"""`planish run PIPELINE NAME=VALUE...`: the pipelines of the repository, without a clone of it."""

import subprocess
import sys

from . import PlanishError, programs
from ._plan import pipeline, share

USAGE = """planish run PIPELINE [NAME=VALUE...]   run a pipeline: planish run raster surface=mirror tif=tool machine=m.json
planish show PIPELINE                  its settings, with their defaults and units
planish list                           pipelines, fixture mirrors, machines, planish.m and a notebook, that are here
planish-STAGE --help                   one stage at a time; from Python: import planish
"""


def main():
    arguments = sys.argv[1:]
    goal = arguments[0] if arguments else ""
    if goal in ("", "-h", "--help", "help"):
        print(USAGE, end="")
        return 0
    if goal == "list":
        for folder, ending in (("pipelines", ".just"), ("fixtures", ".json"), ("fixtures/machines", ".json")):
            found = [p for p in sorted((share() / folder).glob(f"*{ending}")) if p.stem != "stages"]
            # A pipeline takes the name of a fixture, and the path of a machine.
            own_line = folder.endswith("machines")
            print(f"{folder}:" + "".join(f"\n  {p}" if own_line else f" {p.stem}" for p in found))
        for what, file in (("MATLAB and Octave", "planish.m"), ("notebook", "notebook.ipynb")):
            print(f"{what}: {next(share().rglob(file))}")
        print(f"programs (PLANISH_PROGRAMS): {programs()}")
        return 0
    if goal not in ("run", "show"):
        print(f"error: '{goal}' is no command\n{USAGE}", end="", file=sys.stderr)
        return 2
    if len(arguments) < 2:
        print(f"error: {goal} what? Give a pipeline: planish {goal} raster (planish list names them)", file=sys.stderr)
        return 2
    try:
        command, environment = pipeline(*arguments)
    except PlanishError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return subprocess.run(command, env=environment).returncode


if __name__ == "__main__":
    sys.exit(main())
