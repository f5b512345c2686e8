"""What an editor and a type checker see of Planish: `mypy --strict` on lines of a user, and the help of functions.

    environment/bin/python try_types.py        in an empty directory; ends with 0 when all of it is as it should be

Needs mypy in the environment, and the file _stages.pyi beside the module, which the wheel has.
"""

import inspect
import pathlib
import re
import subprocess
import sys

import planish

GOOD = """
import numpy as np, planish
surface = [np.load(f"mirror/{name}.npy") for name in ("height_nm", "x_mm", "y_mm")]
plan = planish.plan(surface, "tool", {"name": "lab"}, "raster", pitch_mm=2)
path = planish.toolpath.raster(surface=surface, tif="tool", pitch_mm=2, step_mm=2.5, scan="y")
reveal_type(planish.dwell.bounded_least_squares(surface=surface, tif="tool", tool_path=path)["dwell_s"])
reveal_type(planish.refine(surface=surface, tif="tool", tool_path=path, machine="lab.json")["trajectory"])
reveal_type(plan.rms_nm), reveal_type(planish.__version__)
"""
# Each line is a mistake, and a part of the message of mypy.
BAD = {
    'planish.toolpath.raster(surface="mirror", pich_mm=2)': 'Unexpected keyword argument "pich_mm"',
    'planish.toolpath.raster(surface="mirror", tif="tool", pitch_mm="2 mm", step_mm=1)': 'has incompatible type "str"',
    'planish.toolpath.zigzag(surface="mirror")': 'has no attribute "zigzag"',
    'planish.polish(surface="mirror")': 'has no attribute "polish"',
    'planish.plan("mirror", "tool")': 'Missing positional argument "machine"',
    "planish.plan(1.0, 2.0, 3.0)": 'has incompatible type "float"',
}


def mypy(text):
    """The exit code and the messages of `mypy --strict` for a script."""
    pathlib.Path("script.py").write_text(text)
    ran = subprocess.run([sys.executable, "-m", "mypy", "--strict", "script.py"], capture_output=True, text=True)
    return ran.returncode, ran.stdout + ran.stderr


def lines_of_a_user_are_typed():
    code, said = mypy(GOOD)
    assert code == 0, said
    kinds = re.findall(r'Revealed type is "(.*)"', said)
    assert len(kinds) == 4 and "ndarray" in kinds[0] and "planish.Artifact" in kinds[1], said
    assert [kind.split(".")[-1] for kind in kinds[2:]] == ["float", "str"], kinds


def mistakes_are_seen():
    code, said = mypy("import planish\n" + "\n".join(BAD) + "\n")
    assert code == 1, said
    for number, (line, message) in enumerate(BAD.items(), 2):
        assert any(found.startswith(f"script.py:{number}:") and message in found for found in said.splitlines()), f"{line}\n{said}"


def help_has_the_sections_of_numpydoc():
    for function in (planish.plan, planish.toolpath.raster, planish.verify._itself):
        text = inspect.getdoc(function)
        assert "Parameters\n----------\n" in text and "Returns\n-------\n" in text, text
    raster = inspect.getdoc(planish.toolpath.raster)
    assert "pitch_mm : float" in raster and "--" not in raster.split("Parameters\n")[0], raster
    assert re.fullmatch(r"\d+\.\d+\.\d+", planish.__version__), planish.__version__


if __name__ == "__main__":
    lines_of_a_user_are_typed()
    mistakes_are_seen()
    help_has_the_sections_of_numpydoc()
    print("types and help are as they should be")
