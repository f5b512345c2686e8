"""From arrays to a plan: `planish.plan`, its result, and maps as files of other programs."""

from __future__ import annotations

import html
import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import threading
import typing
import warnings
import webbrowser

import numpy as np

from . import _BARE, Artifact, PlanishError, PlanishWarning, _stage, _TemporaryFolder, _word, load, programs, save

# Maps of a plan, by their attributes
_MAPS_OF_A_PLAN = ("height_nm", "removal_nm", "residual_nm")

# Length of a record of FITS, in bytes, and of a line of its header (FITS 4.0, 3.1 and 3.3.1).
_FITS_RECORD, _FITS_LINE = 2880, 80

if typing.TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.figure
    import pandas
    import xarray

    from ._stages import MapLike

    # The kind of array that the surface was given as
    Map = typing.Union[np.ndarray, xarray.DataArray]

# Part of the pixels of a map, %, that the colours of its picture reach. Larger: one pit makes the rest pale.
_COLOURED_PERCENT = 99.0


def share() -> pathlib.Path:
    """The folder with pipelines/ and fixtures/: in the wheel, or the clone."""
    here = pathlib.Path(__file__).resolve().parent
    return here / "share" if (here / "share").is_dir() else here.parents[1]


def pipeline(*arguments: str) -> tuple[list[str], dict[str, str]]:
    """Command and environment of `planish run` and `planish show`."""
    folder = programs()
    environment = {**os.environ, "PLANISH_PROGRAMS": str(folder), "PLANISH_SHARE": str(share()), "PLANISH_PROGRESS": "1"}
    return [str(folder / "planish-run"), *arguments], environment


def plan(
    surface: MapLike,
    tif: MapLike,
    machine: typing.Mapping[str, typing.Any] | str | os.PathLike[str],
    path: str = "maze",
    *,
    out: str | os.PathLike[str] | None = None,
    progress: bool | typing.Callable[[str], None] | None = None,
    **settings: typing.Any,
) -> Plan:
    """Plans the removal of `surface` by the tool `tif` on `machine`, along a tool path of the pipeline `path`.

    Parameters
    ----------
    surface : (map, x, y), xarray.DataArray, Artifact or path
        Heights in nm, (ny, nx), material above the target is positive, with coordinates in mm. NaN or a mask marks an
        invalid pixel. An xarray.DataArray has the dimensions y and x; its `units`, where it states them, are nm and mm.
        A path is that of an artifact, or of an instrument's file (with `surface_settings`).
    tif : (map, x, y), xarray.DataArray, Artifact or path
        Removal rates in nm/s over the offsets from the tool in mm, likewise (with `tif_settings`).
    machine : mapping or path
        Limits of the axes, or the JSON file that holds them.
    path : str, default "maze"
        Name of the pipeline: raster, maze, random-adaptive, spiral and others.
    out : path, optional
        Directory of the run. Without it the directory is temporary, and Python removes it with the plan.
    progress : bool or function, optional
        Shows the stage that runs and the number of stages: by default in a notebook and on a terminal. A function is
        given each text, such as "stage 3 of 21: planish toolpath raster".
    **settings
        Settings of the pipeline, which `planish show raster` lists: `pitch_mm=2, plan_joint=False, export="galil"`.

    Returns
    -------
    Plan
        The recommended plan. A negative verdict raises nothing: it is `Plan.negative`.

    Raises
    ------
    PlanishError
        A program could not run; the message names the argument, the value and the remedy.

    Warns
    -----
    PlanishWarning
        A program doubts an input, such as a map that is probably in another unit.

    Examples
    --------
    >>> plan = planish.plan((height_nm, x_mm, y_mm), (rate_nm_per_s, dx_mm, dy_mm), "machine.json", "raster", pitch_mm=2)
    >>> plan.rms_nm, plan.time_s
    """
    temporary = _TemporaryFolder() if out is None else None
    base = (temporary.path if temporary is not None else pathlib.Path(out or "")).resolve()
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
    # Arrays were given, not the files that hold them.
    folders = {base / "mirror": "surface", base / "tool": "tif", base / "machine.json": "machine", base / "run": "out"}
    for folder, argument in folders.items():
        said = [line.replace(str(folder), argument) for line in said]
    if ended not in (0, 1):
        errors = [line for line in said if re.match(r"(internal )?error: ", line)]
        raise PlanishError("\n".join(line.removeprefix("error: ") for line in errors or said[-5:]))
    verdicts = [line.removeprefix("verdict: ") for line in said if line.startswith("verdict: ")]
    made = Plan(base / "run", surface if hasattr(surface, "dims") else None, temporary)
    made.negative = (verdicts or ["the verdict is negative"])[-1] if ended == 1 else None
    for line in dict.fromkeys(said):
        if line.startswith("warning: ") and _BARE not in line:
            warnings.warn(line.removeprefix("warning: "), PlanishWarning, stacklevel=2)
    return made


class Plan:
    """A plan: the one that the report recommends, among those that `methods` names.

    `path` is the directory of the run, `summary` what the report says of it in numbers, `negative` why the verdict is
    negative, or None.
    """

    negative: str | None = None

    def __init__(
        self, path: str | os.PathLike[str], like: typing.Any = None, temporary: _TemporaryFolder | None = None
    ):
        self.path = pathlib.Path(path)
        self._like = like
        self._temporary = temporary
        self.summary: dict[str, typing.Any] = json.loads((self.path / "report/summary.json").read_text("utf-8"))

    @property
    def methods(self) -> list[str]:
        """The plans that were made, by their rows of the report."""
        return list(self.summary["methods"])

    @property
    def method(self) -> str:
        """The recommended plan, or without one the last that was made."""
        return str(self.summary["answer"]["method"] or self.methods[-1])

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
        return float(self.summary["methods"][self.method]["rms_nm"])

    @property
    def time_s(self) -> float:
        """Length of the run, s."""
        return float(self.summary["methods"][self.method]["total_time_s"])

    def program(self, controller: str, out: str | os.PathLike[str] | None = None, **settings: typing.Any) -> pathlib.Path:
        """Writes the plan as a program of `controller` (galil, gcode and others: `dir(planish.export)`), and returns its path.

        `settings` are those of `planish.export.galil` and its siblings. Without `out` the program lies beside the plan,
        and is removed with a temporary directory. A plan whose segments are too short for the controller raises
        PlanishError; `plan(..., export="galil")` then chooses another one, reads its program back and judges it.
        """
        export = _stage("export")
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

    def plot(self, ax: matplotlib.axes.Axes | None = None) -> matplotlib.figure.Figure:
        """Draws the surface error with the tool path, and the predicted residual.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes for the predicted residual alone; a new figure has both maps.

        Returns
        -------
        matplotlib.figure.Figure
            The figure. Heights are from the mean of their map; the colours are centred on zero and reach 99 % of the
            pixels. A millimetre is equally long along x and y.
        """
        try:
            import matplotlib.pyplot as plt
        except ImportError as error:
            raise PlanishError("plot needs Matplotlib: pip install matplotlib") from error
        figure: typing.Any
        if ax is not None:
            figure = ax.figure
            maps = [(ax, "Predicted residual", self.residual_nm)]
        else:
            figure, rows = plt.subplots(2, 1, figsize=(9, 6), layout="constrained")
            maps = [(rows[0], "Surface error", self.height_nm), (rows[1], "Predicted residual", self.residual_nm)]
            rows[0].plot(*self.tool_path["point_mm"].T, color="black", linewidth=0.4)
        for axes, title, height in maps:
            height = np.asarray(height) - np.nanmean(height)
            most = np.nanpercentile(np.abs(height), _COLOURED_PERCENT) or 1.0
            image = axes.pcolormesh(self.x_mm, self.y_mm, height, cmap="RdBu_r", vmin=-most, vmax=most, rasterized=True)
            axes.set(title=f"{title}, {np.nanstd(height):.3g} nm RMS", xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
            figure.colorbar(image, ax=axes, label="height (nm)", extend="both")
        return figure

    def to_xarray(self) -> xarray.Dataset:
        """Returns surface error, predicted removal and residual as a Dataset with the dimensions y and x.

        Every variable and coordinate has its unit (`attrs["units"]`). The attributes hold the method, the RMS in nm and
        the time in s.
        """
        try:
            import xarray
        except ImportError as error:
            raise PlanishError("to_xarray needs xarray: pip install xarray") from error
        maps = {name: (("y", "x"), np.asarray(getattr(self, name)), {"units": "nm"}) for name in _MAPS_OF_A_PLAN}
        coords = {"x": ("x", self.x_mm, {"units": "mm"}), "y": ("y", self.y_mm, {"units": "mm"})}
        return xarray.Dataset(maps, coords, {"method": self.method, "rms_nm": self.rms_nm, "time_s": self.time_s})

    def table(self) -> pandas.DataFrame:
        """Returns the numbers of every plan of the run, a row per method; units end the names of the columns."""
        try:
            import pandas
        except ImportError as error:
            raise PlanishError("table needs pandas: pip install pandas") from error
        rows = {
            method: {name: value for name, value in numbers.items() if isinstance(value, (bool, int, float, str))}
            for method, numbers in self.summary["methods"].items()
        }
        return pandas.DataFrame.from_dict(rows, orient="index").rename_axis("method")

    def __repr__(self) -> str:
        return f"<plan {self.path}: {self.summary['answer']['sentence'] or self.method}>"

    def _repr_html_(self) -> str:
        """Returns the answer of the report and a row per plan, for a notebook."""
        rows = "".join(
            f"<tr><td>{html.escape(method)}{' *' * (method == self.method)}</td>"
            f"<td>{_figures(numbers.get('rms_nm'))}</td><td>{_figures(numbers.get('total_time_s'))}</td></tr>"
            for method, numbers in self.summary["methods"].items()
        )
        sentence = html.escape(self.summary["answer"]["sentence"] or self.method)
        doubt = f"<p><b>{html.escape(self.negative)}</b></p>" if self.negative else ""
        head = "<tr><th>plan</th><th>residual, nm RMS</th><th>time, s</th></tr>"
        return f"<p>{sentence}</p>{doubt}<table>{head}{rows}</table>"

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


def _figures(value: float | None) -> str:
    """Returns a number with four significant digits, or a dash."""
    return "-" if value is None else f"{value:.4g}"


def save_map(file: str | os.PathLike[str], surface: typing.Any, name: str = "height_nm") -> pathlib.Path:
    """Writes a map in nm to an HDF5 file (.h5, .hdf5) or a FITS image (.fits), with its units and coordinates.

    `surface` is (map, x, y) or an xarray.DataArray, as for `plan`, or a plan or an artifact, whose map is `name`:
    save_map("residual.fits", plan, "residual_nm"). The file must not exist. `planish import surface` reads it back. HDF5
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
        stage = ""
        for line in ran.stderr:
            line = line.rstrip("\n")
            if line.startswith("progress: "):
                stage = line.removeprefix("progress: ")
            elif line.startswith("planish "):
                show(f"stage {stage}: {' '.join(word for word in line.split()[:3] if not word.startswith('--'))}")
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
