"""Planish from Python: artifacts as NumPy arrays, and every command as a function.

    import numpy as np, planish

    plan = planish.plan((height, x, y), (rate, dx, dy), "machine.json", "raster", pitch_mm=2)
    plan.residual_nm, plan.plot(), plan.report(), plan.program("galil")

Or stage by stage:

    planish.save("mirror", height_nm=height, x_mm=x, y_mm=y)
    planish.save("tool", rate_nm_per_s=rate, x_mm=dx, y_mm=dy)
    path = planish.toolpath.raster(surface="mirror", tif="tool", pitch_mm=1, step_mm=1, out="path")
    dwell = planish.dwell.bounded_least_squares(surface="mirror", tif="tool", tool_path=path, out="dwell")
    dwell["dwell_s"].sum()

An artifact is a directory of arrays with their units in their names, and a manifest (docs/formats.md). The functions
are made of what the programs say of themselves (`planish-dwell --describe`), one for each subcommand; a flag
`--pitch-mm` is the argument `pitch_mm`, and a word of Python has an underscore at its end (`planish.import_`,
`return_`). They run the programs, so that what they write has the bytes of the command line.
`help(planish.dwell.bounded_least_squares)` shows the flags with their units and defaults.
"""

from __future__ import annotations

import functools
import inspect
import json
import keyword
import os
import pathlib
import shutil
import subprocess
import sysconfig
import tempfile
import typing

import numpy as np

__all__ = ["Artifact", "Plan", "PlanishError", "load", "plan", "programs", "save", "save_map"]

# Warnings about arrays without a manifest that were printed: every program that reads them gives the same one.
_SAID: set[str] = set()

_EXECUTABLE = ".exe" if os.name == "nt" else ""


class PlanishError(RuntimeError):
    """A program could not run: its message, which names the argument, the value and the remedy."""


class Artifact:
    """A directory of arrays: `artifact["height_nm"]`, `artifact.manifest`, `artifact.path`.

    `negative` is why the verdict of the program that made it is negative (a limit exceeded, not converged), or None.
    """

    def __init__(self, path: str | os.PathLike[str], arrays: dict[str, np.ndarray], manifest: dict[str, typing.Any]):
        self.path = pathlib.Path(path)
        self.arrays = arrays
        self.manifest = manifest

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.arrays:
            raise KeyError(f"{self.path} has no array {name!r}; there are {', '.join(sorted(self.arrays)) or 'none'}")
        return self.arrays[name]

    def __fspath__(self) -> str:
        return str(self.path)

    @property
    def kind(self) -> str | None:
        """Kind of the artifact, such as "surface"; None of bare arrays."""
        return self.manifest.get("kind")

    @property
    def outcome(self) -> dict[str, typing.Any]:
        """What the program reports."""
        return self.manifest.get("outcome", {})

    @property
    def negative(self) -> str | None:
        """Reason of a negative verdict, or None."""
        return self.outcome.get("reason") if self.outcome.get("status") == "negative" else None

    def __repr__(self) -> str:
        arrays = ", ".join(f"{name} {array.shape}" for name, array in sorted(self.arrays.items()))
        return f"<{self.kind or 'arrays'} {self.path}: {arrays}>"


def load(path: str | os.PathLike[str]) -> Artifact:
    """The artifact in the directory `path`."""
    path = pathlib.Path(path)
    if not path.is_dir():
        raise PlanishError(f"{path}: is no directory; give the directory that a program wrote, or planish.save")
    arrays = {file.stem: np.load(file, allow_pickle=False) for file in sorted(path.glob("*.npy"))}
    manifest = path / "manifest.json"
    if not arrays and not manifest.exists():
        raise PlanishError(f"{path}: has neither arrays nor a manifest; give the directory of an artifact")
    return Artifact(path, arrays, json.loads(manifest.read_text("utf-8")) if manifest.exists() else {})


def save(path: str | os.PathLike[str], **arrays: typing.Any) -> pathlib.Path:
    """Writes arrays under their names, with their units, as an artifact: save("mirror", height_nm=..., x_mm=..., y_mm=...).

    A map has the shape (ny, nx), row 0 at the smallest y; NaN marks an invalid pixel, and so does the mask of a masked
    array. `path` must not exist, or be the directory of an earlier save of the same names: what is not of this function
    is never replaced.
    """
    path = pathlib.Path(path)
    if not arrays:
        raise TypeError("save needs arrays, such as height_nm=..., x_mm=..., y_mm=...")
    wanted = {f"{name}.npy" for name in arrays}
    found = {entry.name for entry in path.iterdir()} if path.is_dir() else {""} if path.exists() else set()
    if found and found != wanted:
        raise FileExistsError(f"{path}: holds something else; give another directory, or remove it")
    converted = {}
    for name, array in arrays.items():
        array = np.asanyarray(array)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"{name}: has the type {array.dtype}; give real numbers")
        if np.ma.is_masked(array):
            # Under a mask lies any number, often 9999; as a plain array it would be a height.
            array = array.astype(float).filled(np.nan)
        converted[name] = np.ascontiguousarray(array)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as temporary:
        for name, array in converted.items():
            np.save(pathlib.Path(temporary, f"{name}.npy"), array)
        path.mkdir(exist_ok=True)
        for name in converted:
            os.replace(pathlib.Path(temporary, f"{name}.npy"), path / f"{name}.npy")
    return path


@functools.lru_cache(maxsize=None)
def programs() -> pathlib.Path:
    """The folder of the programs: PLANISH_PROGRAMS, beside this Python, or in the PATH."""
    given = os.environ.get("PLANISH_PROGRAMS")
    folders = [given] if given else [sysconfig.get_path("scripts"), sysconfig.get_path("scripts", "posix_user")]
    for folder in filter(None, folders):
        if pathlib.Path(folder, f"planish-run{_EXECUTABLE}").is_file():
            return pathlib.Path(folder)
    found = None if given else shutil.which("planish-run")
    if found is None:
        raise PlanishError("the programs of Planish are not here; pip install the wheel, or set PLANISH_PROGRAMS")
    return pathlib.Path(found).parent


class _Program:
    """A program; its subcommands are attributes."""

    def __init__(self, name):
        file = programs() / f"planish-{name}{_EXECUTABLE}"
        described = subprocess.run([file, "--describe"], capture_output=True, check=True)
        description = json.loads(described.stdout)
        self.__doc__ = description["about"]
        self.__name__ = description["program"]
        self._commands = {}
        for command in description["commands"]:
            function = _function(file, command)
            if command["name"]:
                self._commands[command["name"].replace("-", "_")] = function
            else:
                self._itself = function

    def __getattr__(self, name):
        commands = self.__dict__.get("_commands", {})
        if name in commands:
            return commands[name]
        raise AttributeError(f"{self.__name__} has no command {name!r}; there are {', '.join(sorted(commands))}")

    def __dir__(self):
        return [*super().__dir__(), *self._commands]

    def __call__(self, *positional, **flags):
        if "_itself" not in self.__dict__:
            raise TypeError(f"{self.__name__} has commands: {', '.join(sorted(self._commands))}")
        return self._itself(*positional, **flags)


def _function(file, command):
    """A function that runs one command of a program."""
    flags = {_argument(flag["name"]): flag for flag in command["flags"]}
    name = " ".join(filter(None, [file.stem, command["name"]]))

    def function(*positional, **given):
        words = [command["name"]] if command["name"] else []
        places = [flag for flag in flags.values() if flag["positional"]]
        if len(positional) > len(places) and not (places and places[-1]["repeats"]):
            raise TypeError(f"{name} takes {len(places)} argument(s) without a name, {len(positional)} were given")
        words += [_word(value) for value in positional]
        for key, value in given.items():
            if key not in flags:
                raise TypeError(f"{name} has no argument {key!r}; there are {', '.join(flags)}")
            words += _words(flags[key], value)
        ran = subprocess.run([file, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for line in ran.stderr.splitlines():
            if ran.returncode != 2 and line not in _SAID:
                print(line)
            if ": no manifest.json, read as bare arrays" in line:
                _SAID.add(line)
        if ran.returncode not in (0, 1):
            raise PlanishError(ran.stderr.strip() or f"{name} ended with {ran.returncode}")
        out = given.get("out")
        return _made(pathlib.Path(out)) if out is not None and pathlib.Path(out).is_dir() else ran.stdout

    function.__name__ = function.__qualname__ = name
    function.__doc__ = "\n".join([command["about"], "", *map(_line, flags.items())])
    parameter = inspect.Parameter
    function.__signature__ = inspect.Signature(
        [
            parameter(key, parameter.KEYWORD_ONLY, default=parameter.empty if flag["required"] else flag["default"])
            for key, flag in flags.items()
            if not flag["positional"]
        ]
    )
    return function


def _made(out):
    """The artifact in `out`; of a program that writes several, such as planish.refine, those in it by their names."""
    if (out / "manifest.json").exists():
        return load(out)
    return {folder.name: load(folder) for folder in sorted(out.iterdir()) if (folder / "manifest.json").exists()}


def _argument(name):
    """`pitch-mm` is pitch_mm; a word of Python, such as `return`, has an underscore at its end."""
    name = name.replace("-", "_")
    return f"{name}_" if keyword.iskeyword(name) else name


def _line(item):
    key, flag = item
    default = f" [default: {flag['default']}]" if flag["default"] and "[default" not in flag["help"] else ""
    choices = f" [{', '.join(flag['choices'])}]" if flag["choices"] else ""
    return f"    {key}: {' '.join(flag['help'].split())}{choices}{default}"


def _word(value):
    if isinstance(value, (bool, np.bool_)):
        raise TypeError("True and False are for switches")
    if isinstance(value, (float, np.floating)):
        # The shortest decimal number that is this one.
        return repr(float(value))
    return os.fspath(value) if isinstance(value, os.PathLike) else str(value)


def _words(flag, value):
    """The words of one flag."""
    name = f"--{flag['name']}"
    least, most = flag["values"]
    if value is None:
        return []
    if most == 0:
        if not isinstance(value, (bool, np.bool_)):
            raise TypeError(f"{flag['name']} is a switch; give True or False")
        return [name] if value else []
    several = isinstance(value, (list, tuple, np.ndarray))
    if flag["positional"]:
        return [_word(v) for v in value] if several else [_word(value)]
    if several and flag["repeats"] and most == 1:
        return [word for v in value for word in (name, _word(v))]
    if several and most > 1:
        # A flag of several values that repeats: [[0.1, 1], [1, 10]] are two bands, [0.1, 1] is one.
        groups = value if flag["repeats"] and all(np.ndim(v) == 1 for v in value) else [value]
        return [word for group in groups for word in (name, *map(_word, group))]
    # X,Y: one value of two numbers. With =, so that a negative number is none of the flags.
    return [f"{name}={','.join(map(_word, value)) if several else _word(value)}"]


def _stages() -> list[str]:
    """Names of the programs as attributes of this module."""
    there = [p.stem[8:] for p in programs().glob("planish-*") if p.suffix in ("", ".exe")]
    return sorted(_argument(name) for name in there)


def __dir__() -> list[str]:
    try:
        return [*__all__, *_stages()]
    except PlanishError:
        return list(__all__)


def __getattr__(name: str) -> typing.Any:
    if name.startswith("_"):
        raise AttributeError(name)
    # `import` is a word of Python: planish.import_.program(...)
    program = name.rstrip("_").replace("_", "-")
    if not (programs() / f"planish-{program}{_EXECUTABLE}").is_file():
        raise AttributeError(f"planish has no program {name!r}; there are {', '.join(_stages())}")
    found = _Program(program)
    globals()[name] = found
    return found


from ._plan import Plan, plan, save_map  # noqa: E402 - it uses what stands above
