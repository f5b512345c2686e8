"""Planish from Python: artifacts as NumPy arrays, and every command as a function.

    import numpy as np, planish

    plan = planish.plan((height, x, y), (rate, dx, dy), "machine.json", "raster", pitch_mm=2)
    plan.residual_nm, plan.plot(), plan.report(), plan.program("galil")

Or stage by stage:

    surface, tif = (height, x, y), (rate, dx, dy)
    path = planish.toolpath.raster(surface=surface, tif=tif, pitch_mm=1, step_mm=1)
    dwell = planish.dwell.bounded_least_squares(surface=surface, tif=tif, tool_path=path)
    dwell["dwell_s"].sum()

An artifact is a directory of arrays with their units in their names, and a manifest (docs/formats.md). Without `out` it
is temporary: Python removes it with the last reference to it. The functions are made of what the programs say of
themselves (`planish dwell --describe`), one for each subcommand; a flag `--pitch-mm` is the argument `pitch_mm`, and a
word of Python has an underscore at its end (`planish.import_`, `return_`). They run the programs, so that what they
write has the bytes of the command line. `help(planish.dwell.bounded_least_squares)` shows the arguments with their units
and defaults, and `_stages.pyi` states their types.
"""

from __future__ import annotations

import functools
import importlib.metadata
import inspect
import json
import keyword
import os
import pathlib
import re
import shutil
import subprocess
import sysconfig
import tempfile
import typing
import warnings
import weakref

import numpy as np

if typing.TYPE_CHECKING:
    from ._stages import *

__all__ = ["Artifact", "Plan", "PlanishError", "PlanishWarning", "load", "plan", "programs", "save", "save_map"]

# Warning about arrays without a manifest, which are what users give.
_BARE = ": no manifest.json, read as bare arrays"

# Arguments that may be a map with its coordinates: the name of the array, and its unit.
_MAPS = {"surface": ("height_nm", "nm"), "tif": ("rate_nm_per_s", "nm/s")}

_EXECUTABLE = ".exe" if os.name == "nt" else ""


class PlanishError(RuntimeError):
    """A program could not run: its message, which names the argument, the value and the remedy."""


class PlanishWarning(UserWarning):
    """A doubt of a program, such as a map that is probably in another unit."""


def _version() -> str:
    """Returns the version of the installed package, or in a clone that of its pyproject.toml."""
    try:
        return importlib.metadata.version("planish")
    except importlib.metadata.PackageNotFoundError:
        text = pathlib.Path(__file__).resolve().parents[1].joinpath("pyproject.toml").read_text("utf-8")
        return re.search(r'^version = "(.*)"', text, re.MULTILINE)[1]  # type: ignore[index]


__version__ = _version()


class _TemporaryFolder:
    """A folder that is removed with the last reference to it."""

    def __init__(self) -> None:
        self.path = pathlib.Path(tempfile.mkdtemp(prefix="planish-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


class Artifact:
    """A directory of arrays: `artifact["height_nm"]`, `artifact.manifest`, `artifact.path`.

    `negative` is why the verdict of the program that made it is negative (a limit exceeded, not converged), or None.
    """

    def __init__(self, path: str | os.PathLike[str], arrays: dict[str, np.ndarray], manifest: dict[str, typing.Any]):
        self.path = pathlib.Path(path)
        self.arrays = arrays
        self.manifest = manifest
        # The folder of a temporary artifact, which is removed with it
        self._temporary: _TemporaryFolder | None = None

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
        self.__name__ = f"planish.{_argument(name)}"
        self._commands = {}
        for command in description["commands"]:
            function = _function(file, self.__name__, command)
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


def _function(file, program, command):
    """A function that runs one command of the program in `file`, which is `program` in Python."""
    flags = {_argument(flag["name"]): flag for flag in command["flags"]}
    name = ".".join(filter(None, [program, command["name"].replace("-", "_")]))

    def function(*positional, **given):
        words = [command["name"]] if command["name"] else []
        places = [flag for flag in flags.values() if flag["positional"]]
        if len(positional) > len(places) and not (places and places[-1]["repeats"]):
            raise TypeError(f"{name} takes {len(places)} argument(s) without a name, {len(positional)} were given")
        words += [_word(value) for value in positional]
        temporary = _TemporaryFolder()
        # The folder of each argument that is no path, for the messages
        folders = {}
        if given.get("out") is None and _writes_artifacts(flags):
            given["out"] = folders["out"] = temporary.path / "out"
        for key, value in given.items():
            if key not in flags:
                raise TypeError(f"{name} has no argument {key!r}; there are {', '.join(flags)}")
            path = _saved(key, value, temporary.path)
            if path is not None:
                folders[key] = value = path
            words += _words(flags[key], value)
        missing = [key for key, flag in flags.items() if flag["required"] and not flag["positional"] and key not in given]
        if missing:
            raise TypeError(f"{name} needs {' and '.join(missing)}")
        ran = subprocess.run([file, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        said = [_in_arguments(line, flags, folders) for line in ran.stderr.splitlines()]
        if ran.returncode not in (0, 1):
            errors = [line for line in said if not line.startswith("warning: ")]
            raise PlanishError("\n".join(errors).strip() or f"{name} ended with {ran.returncode}")
        for line in said:
            if not line.startswith("warning: "):
                print(line)
            elif _BARE not in line:
                # A program without subcommands is called through _Program.__call__.
                warnings.warn(line.removeprefix("warning: "), PlanishWarning, stacklevel=2 if command["name"] else 3)
        out = given.get("out")
        if out is None or not pathlib.Path(out).is_dir():
            return ran.stdout
        made = _made(pathlib.Path(out))
        if "out" in folders:
            for artifact in made.values() if isinstance(made, dict) else [made]:
                artifact._temporary = temporary
        return made

    function.__name__ = function.__qualname__ = name
    function.__doc__ = _documentation(command, flags)
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


def _writes_artifacts(flags):
    """Returns true if a command with these arguments writes artifacts, for which a temporary directory can stand."""
    return flags.get("out", {}).get("value") == "DIR"


def _documentation(command, flags):
    """Returns the description of a command and of its arguments, as numpydoc has it."""
    text = f"{command['about']}\n\nParameters\n----------\n"
    for key, flag in flags.items():
        required = flag["required"] and not (key == "out" and _writes_artifacts(flags))
        default = "" if required else f", default {flag['default']}" if flag["default"] else ", optional"
        text += f"{key} : {_type(key, flag)}{default}\n    {' '.join(flag['help'].split())}\n"
    return f"{text}\nReturns\n-------\n{_returned(flags)}\n"


def _type(key, flag):
    """Returns the type of an argument in words."""
    if flag["choices"]:
        return "{" + ", ".join(map(repr, flag["choices"])) + "}"
    if flag["values"][1] == 0:
        return "bool"
    if key in _MAPS:
        return "(map, x, y), xarray.DataArray, Artifact or path"
    one = {"number": "float", "integer": "int", "path": "path or Artifact"}.get(flag.get("type"), "str")
    one = "mapping or path" if key == "machine" else one
    return f"sequence of {one}" if flag["values"][1] > 1 else f"{one} or sequence of them" if flag["repeats"] else one


def _returned(flags):
    """Returns what a function with these arguments returns, in words."""
    if _writes_artifacts(flags):
        return "Artifact, or dict of them by their names\n    What the command wrote; temporary without `out`."
    return "str\n    What the command printed."


def _saved(key, value, folder):
    """Returns the path below `folder` where a map or a machine that is no path was saved; None for other values."""
    from ._plan import _map_with_coordinates

    if isinstance(value, (str, os.PathLike)) or value is None:
        return None
    if key in _MAPS:
        array, unit = _MAPS[key]
        values, x, y = _map_with_coordinates(value, unit)
        return save(folder / key, **{array: values, "x_mm": x, "y_mm": y})
    if key == "machine" and isinstance(value, typing.Mapping):
        file = folder / "machine.json"
        file.write_text(json.dumps(value), "utf-8")
        return file
    return None


def _in_arguments(line, flags, folders):
    """Returns a message of a program with its flags and temporary folders as arguments of Python."""
    for key, folder in folders.items():
        line = line.replace(str(folder), key)
    for key, flag in sorted(flags.items(), key=lambda item: -len(item[0])):
        value = "=True" if flag["values"][1] == 0 else ""
        line = re.sub(rf"--{flag['name']}(?![\w-])", f"{key}{value}", line)
    return line.removeprefix("error: ")


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


def _stage(name: str) -> typing.Any:
    """Returns the program that is the attribute `name` of this module."""
    if name.startswith("_"):
        raise AttributeError(name)
    # `import` is a word of Python: planish.import_.program(...)
    program = name.rstrip("_").replace("_", "-")
    if not (programs() / f"planish-{program}{_EXECUTABLE}").is_file():
        raise AttributeError(f"planish has no program {name!r}; there are {', '.join(_stages())}")
    found = _Program(program)
    globals()[name] = found
    return found


if not typing.TYPE_CHECKING:
    # A type checker has the stages from _stages.pyi, and finds misspelt ones.
    __getattr__ = _stage


from ._plan import Plan, plan, save_map  # noqa: E402 - it uses what stands above
