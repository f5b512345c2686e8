"""From arrays to a plan: `planish.plan`, its result, and maps as files of other programs."""

from __future__ import annotations

import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import threading
import typing
import warnings
import webbrowser

import numpy as np

from . import Artifact, PlanishError, _word, load, programs, save

# Warning about arrays without a manifest, which are what `plan` writes.
_BARE = ": no manifest.json, read as bare arrays"

# Length of a record of FITS, in bytes, and of a line of its header (FITS 4.0, 3.1 and 3.3.1).
_FITS_RECORD, _FITS_LINE = 2880, 80

if typing.TYPE_CHECKING:
    import matplotlib.figure
    import xarray

    # The kind of array that the surface was given as
    Map = typing.Union[np.ndarray, xarray.DataArray]


def share() -> pathlib.Path:
    """The folder with pipelines/ and fixtures/: in the wheel, or the clone."""
    here = pathlib.Path(__file__).resolve().parent
    return here / "share" if (here / "share").is_dir() else here.parents[1]


def pipeline(*arguments: str) -> tuple[list[str], dict[str, str]]:
    """Command and environment of `planish run` and `planish show`."""
    folder = programs()
    environment = {**os.environ, "PLANISH_PROGRAMS": str(folder), "PLANISH_SHARE": str(share())}
    return [str(folder / "planish-run"), *arguments], environment


def plan(
    surface: typing.Any,
    tif: typing.Any,
    machine: typing.Mapping[str, typing.Any] | str | os.PathLike[str],
    path: str = "maze",
    *,
    out: str | os.PathLike[str] | None = None,
    progress: bool | typing.Callable[[str], None] | None = None,
    **settings: typing.Any,
) -> Plan:
    """Plans the removal of `surface` by the tool `tif` on `machine`, along a tool path of the pipeline `path`.

        plan = planish.plan((height_nm, x_mm, y_mm), (rate_nm_per_s, dx_mm, dy_mm), "machine.json", "raster", pitch_mm=2)

    `surface` (heights in nm, material above the target is positive) and `tif` (removal rates in nm/s) are
    - an array of the shape (ny, nx) with its coordinates in mm, as (map, x, y); NaN or a mask marks an invalid pixel,
    - an xarray.DataArray with the dimensions y and x (its `units`, where it states them, are nm or nm/s, and mm), or
    - an artifact, or the path of one or of an instrument's file (with surface_settings, tif_settings).

    `machine` is a mapping with the limits of its axes, or the path of such a JSON file. `settings` are those of the
    pipeline (`planish show maze` lists them): pitch_mm=2, plan_joint=False, export="galil".

    The programs hand files on. They lie in the directory `out`, or in a temporary one that is removed with the result.
    `progress` shows the stage that runs: by default in a notebook and on a terminal; a function is given each text.

    Raises PlanishError with the message of the program that could not run. A negative verdict raises nothing: it is
    `Plan.negative`.
    """
    temporary = tempfile.TemporaryDirectory(prefix="planish-") if out is None else None
    base = pathlib.Path(temporary.name if temporary is not None else out or "").resolve()
    base.mkdir(parents=True, exist_ok=True)
    given = {"surface": _given(surface, base / "mirror", "height_nm", "nm"), "tif": _given(tif, base / "tool", "rate_nm_per_s", "nm/s")}
    if isinstance(machine, typing.Mapping):
        (base / "machine.json").write_text(json.dumps(machine), "utf-8")
        machine = base / "machine.json"
    given["machine"] = pathlib.Path(machine).resolve()
    # A page with 24 more maps per plan is for those who ask for it.
    words = {**given, "frames": 0, **settings, "out": base / "run"}
    run = [f"{name}={'yes' if value is True else 'no' if value is False else _word(value)}" for name, value in words.items()]
    ended, said = _watched(*pipeline("run", path, *run), _shown(progress))
    if ended not in (0, 1):
        errors = [line for line in said if re.match(r"(internal )?error: ", line)]
        raise PlanishError("\n".join(errors or said[-5:]))
    verdicts = [line.removeprefix("verdict: ") for line in said if line.startswith("verdict: ")]
    made = Plan(base / "run", surface if hasattr(surface, "dims") else None, temporary)
    made.negative = (verdicts or ["the verdict is negative"])[-1] if ended == 1 else None
    for line in dict.fromkeys(said):
        if line.startswith("warning: ") and _BARE not in line:
            warnings.warn(line.removeprefix("warning: "), stacklevel=2)
    return made


class Plan:
    """A plan: the one that the report recommends, among those that `methods` names.

    `path` is the directory of the run, `summary` what the report says of it in numbers, `negative` why the verdict is
    negative, or None.
    """

    negative: str | None = None

    def __init__(
        self, path: str | os.PathLike[str], like: typing.Any = None, temporary: tempfile.TemporaryDirectory[str] | None = None
    ):
        self.path = pathlib.Path(path)
        self._like = like
        self._temporary = temporary
        self.summary: dict = json.loads((self.path / "report/summary.json").read_text("utf-8"))

    @property
    def methods(self) -> list[str]:
        """The plans that were made, by their rows of the report."""
        return list(self.summary["methods"])

    @property
    def method(self) -> str:
        """The recommended plan, or without one the last that was made."""
        return self.summary["answer"]["method"] or self.methods[-1]

    @property
    def trajectory(self) -> Artifact:
        """The motion: breaks in s and coefficients in mm of its cubics."""
        return load(self._of("trajectory"))

    @property
    def tool_path(self) -> Artifact:
        """The tool path: `point_mm`, `dwell_point_mm`."""
        return load(self.path / "tool_path")

    @property
    def dwell_s(self) -> np.ndarray:
        """Dwell time of every dwell point of the plan, s."""
        folder = self._of("dwell")
        return load(folder if folder.is_dir() else self.path / "dwell")["dwell_s"]

    @property
    def height_nm(self) -> Map:
        """The surface error that the plan removes, (ny, nx), as it was prepared."""
        return self._map(load(self.path / "surface"), "height_nm")

    @property
    def removal_nm(self) -> Map:
        """The predicted removal of the motion, (ny, nx)."""
        return self._map(load(self._of("removal")), "removal_nm")

    @property
    def residual_nm(self) -> Map:
        """The predicted residual of the motion, (ny, nx)."""
        return self._map(load(self._of("removal")), "residual_nm")

    @property
    def x_mm(self) -> np.ndarray:
        """Coordinates of the columns of these maps."""
        return load(self.path / "surface")["x_mm"]

    @property
    def y_mm(self) -> np.ndarray:
        """Coordinates of the rows of these maps."""
        return load(self.path / "surface")["y_mm"]

    @property
    def rms_nm(self) -> float:
        """RMS of the predicted residual, nm."""
        return self.summary["methods"][self.method]["rms_nm"]

    @property
    def time_s(self) -> float:
        """Length of the run, s."""
        return self.summary["methods"][self.method]["total_time_s"]

    def program(self, controller: str, out: str | os.PathLike[str] | None = None, **settings: typing.Any) -> pathlib.Path:
        """Writes the plan as a program of `controller` (galil, gcode and others: `dir(planish.export)`), and returns its path.

        `settings` are those of `planish.export.galil` and its siblings. Without `out` the program lies beside the plan,
        and is removed with a temporary directory. A plan whose segments are too short for the controller raises
        PlanishError; `plan(..., export="galil")` then chooses another one, reads its program back and judges it.
        """
        from . import export

        if controller not in export._commands:
            raise PlanishError(f"{controller!r} is no controller; give one of {', '.join(export._commands)}")
        # The row of a program is not the plan but what the controller makes of it.
        method = self.method.rpartition("+")[0] if self.method.endswith(f"+{self._exported}") else self.method
        program = pathlib.Path(out) if out is not None else self.path.parent / f"program.{controller}"
        (machine,) = (self.path / "machine").glob("*.json")
        getattr(export, controller)(
            trajectory=self.path / "methods" / method / "trajectory", machine=machine, out=program, force=True, **settings
        )
        return program

    def report(self, show: bool = False) -> pathlib.Path:
        """The page that compares the plans; with `show` it opens in the browser."""
        page = self.path / "report/report.html"
        if show:
            webbrowser.open(page.as_uri())
        return page

    def plot(self) -> matplotlib.figure.Figure:
        """A Matplotlib figure: the surface error with the tool path, and the predicted residual."""
        try:
            import matplotlib.pyplot as plt
        except ImportError as error:
            raise PlanishError("plot needs Matplotlib: pip install matplotlib") from error
        removal = load(self._of("removal"))
        figure, rows = plt.subplots(2, 1, figsize=(9, 6), layout="constrained")
        for axes, title, height in zip(rows, ("Surface error", "Predicted residual"), (self.height_nm, removal["residual_nm"])):
            height = np.asarray(height)
            height = height - np.nanmean(height)
            image = axes.pcolormesh(removal["x_mm"], removal["y_mm"], height, cmap="RdBu_r", rasterized=True)
            axes.set(title=f"{title}, {np.nanstd(height):.3g} nm RMS", xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
            figure.colorbar(image, ax=axes, label="height (nm)")
        rows[0].plot(*self.tool_path["point_mm"].T, color="black", linewidth=0.4)
        return figure

    def __repr__(self) -> str:
        return f"<plan {self.path}: {self.summary['answer']['sentence'] or self.method}>"

    @property
    def _exported(self):
        """Controller whose program was written with the plan."""
        return next((p.suffix[1:] for p in self.path.glob("program.*") if p.suffix != ".json"), None)

    def _of(self, part):
        return self.path / "methods" / self.method / part

    def _map(self, artifact, name):
        if self._like is None:
            return artifact[name]
        y, x = _directions(self._like)
        array = type(self._like)(
            artifact[name], dims=(y, x), coords={y: artifact["y_mm"], x: artifact["x_mm"]}, name=name, attrs={"units": "nm"}
        )
        for axis in (y, x):
            array[axis].attrs["units"] = "mm"
        return array


def save_map(file: str | os.PathLike[str], surface: typing.Any, name: str = "height_nm") -> pathlib.Path:
    """Writes a map in nm to an HDF5 file (.h5, .hdf5) or a FITS image (.fits), with its units and coordinates.

    `surface` is (map, x, y) or an xarray.DataArray, as for `plan`, or a plan or an artifact, whose map is `name`:
    save_map("residual.fits", plan, "residual_nm"). The file must not exist. `planish-import surface` reads it back. HDF5
    needs h5py.
    """
    file = pathlib.Path(file)
    if file.exists():
        raise FileExistsError(f"{file}: is there; give another file, or remove it")
    if isinstance(surface, Artifact):
        surface = (surface[name], surface["x_mm"], surface["y_mm"])
    elif isinstance(surface, Plan):
        surface = (np.asarray(getattr(surface, name)), surface.x_mm, surface.y_mm)
    values, x, y = _map_with_coordinates(surface, "nm")
    if file.suffix in (".h5", ".hdf5"):
        try:
            import h5py
        except ImportError as error:
            raise PlanishError("an HDF5 file needs h5py: pip install h5py; or write .fits") from error
        with h5py.File(file, "x") as to:
            for key, array, unit in ((name, values, "nm"), ("x", x, "mm"), ("y", y, "mm")):
                to.create_dataset(key, data=array).attrs["units"] = unit
            for k, axis in enumerate("yx"):
                to[axis].make_scale(axis)
                to[name].dims[k].attach_scale(to[axis])
    elif file.suffix == ".fits":
        file.write_bytes(_fits(values, x, y))
    else:
        raise ValueError(f"{file}: has the ending {file.suffix!r}; give .h5, .hdf5 or .fits")
    return file


def _fits(values, x, y):
    """A FITS image of a map in nm. Coordinate n = CRVALn + CDELTn (i - CRPIXn), i = 1 ... NAXISn."""
    ny, nx = values.shape
    cards = [("SIMPLE", "T"), ("BITPIX", -64), ("NAXIS", 2), ("NAXIS1", nx), ("NAXIS2", ny), ("BUNIT", "'nm      '")]
    for n, at in ((1, x), (2, y)):
        step = (at[-1] - at[0]) / (len(at) - 1)
        if np.abs(at[0] + step * np.arange(len(at)) - at).max() > 1e-4 * step:
            raise ValueError("FITS has no coordinates but steps of one size; give a uniform lattice, or write .h5")
        cards += [(f"CTYPE{n}", f"'{'XY'[n - 1]}       '"), (f"CUNIT{n}", "'mm      '"), (f"CRPIX{n}", 1.0)]
        cards += [(f"CRVAL{n}", float(at[0])), (f"CDELT{n}", float(step))]
    lines = [f"{key:8}= {str(value).upper() if isinstance(value, float) else value:>20}" for key, value in cards]
    header = "".join(line.ljust(_FITS_LINE) for line in [*lines, "END"]).encode("ascii")
    data = values.astype(">f8").tobytes()
    return header.ljust(-(-len(header) // _FITS_RECORD) * _FITS_RECORD) + data.ljust(
        -(-len(data) // _FITS_RECORD) * _FITS_RECORD, b"\0"
    )


def _given(what, folder, name, unit):
    """The path of what `plan` was given; arrays are saved in `folder`."""
    if isinstance(what, (str, os.PathLike)):
        return pathlib.Path(what).resolve()
    values, x, y = _map_with_coordinates(what, unit)
    return save(folder, **{name: values, "x_mm": x, "y_mm": y})


def _map_with_coordinates(what, unit):
    """A map (ny, nx) with its coordinates, from (map, x, y) or from an array of xarray."""
    if hasattr(what, "dims") and hasattr(what, "coords"):
        y, x = _directions(what)
        what = what.transpose(y, x)
        for of, wanted in ((what, unit), (what[x], "mm"), (what[y], "mm")):
            stated = of.attrs.get("units", wanted)
            if stated != wanted:
                raise ValueError(f"{of.name or 'the array'} is in {stated!r}; give it in {wanted}")
        what = (what.values, what[x].values, what[y].values)
    if not isinstance(what, (tuple, list)) or len(what) != 3:
        raise TypeError("give a map as (map, x, y), as an xarray.DataArray, or as a path")
    values = np.ma.asarray(what[0], dtype=float).filled(np.nan)
    x, y = (np.asarray(axis, dtype=float) for axis in what[1:])
    if values.shape != (y.size, x.size):
        turned = "; transpose the map" if values.shape == (x.size, y.size) else ""
        raise ValueError(f"the map has the shape {values.shape}, but there are {y.size} y and {x.size} x{turned}")
    return values, x, y


def _directions(array):
    """The dimensions y and x of an array of xarray, by their names; else the rows are y."""
    if len(array.dims) != 2:
        raise ValueError(f"the array has the dimensions {array.dims}; give one with y and x")
    first, second = array.dims
    return (second, first) if str(first).lower() in ("x", "x_mm", "dx", "dx_mm") else (first, second)


def _watched(command, environment, show):
    """Runs a pipeline: its exit code, and what it said on standard error but for the commands, which `show` gets."""
    said, printed = [], []
    # A group of its own, so that an interrupt of a notebook ends the stage, too.
    ran = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace", start_new_session=True
    )
    reader = threading.Thread(target=lambda: printed.extend(ran.stdout), daemon=True)
    reader.start()
    try:
        stage = 0
        for line in ran.stderr:
            line = line.rstrip("\n")
            if line.startswith("planish-"):
                stage += 1
                show(f"stage {stage}: {' '.join(word for word in line.split()[:2] if not word.startswith('--'))}")
            else:
                said.append(line)
        ran.wait()
    except BaseException:
        os.killpg(ran.pid, signal.SIGTERM)
        ran.wait()
        raise
    finally:
        show("")
    reader.join()
    return ran.returncode, said


def _shown(progress):
    """A function that shows a text in the place of the last one; an empty text ends it."""
    if callable(progress):
        return lambda text: progress(text) if text else None
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    notebook = shell is not None and hasattr(shell, "kernel")
    if progress is False or (progress is None and not notebook and not sys.stderr.isatty()):
        return lambda text: None
    if not notebook:
        # Back to the start of the line, and clear it.
        return lambda text: print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
    from IPython.display import display

    handle = display({"text/plain": "planning"}, raw=True, display_id=True)
    return lambda text: handle.update({"text/plain": text or "planned"}, raw=True)
