"""The lines of python/README.md that go from arrays to a program; `planish.plan` beside them, and maps as files of other programs.

    environment/bin/python try_plan.py         in an empty directory; ends with 0 when all of it is as it should be

Needs xarray, h5py, matplotlib and pandas in the environment.
"""

import gc
import pathlib
import sys
import time
import warnings

import matplotlib
import matplotlib.pyplot
import numpy as np
import planish
import xarray

from mirror import MACHINE, arrays, check, write

matplotlib.use("Agg")
README = pathlib.Path(__file__).resolve().parents[1] / "README.md"
# Longest time of its lines, s. It takes 8 s of processor time, so a busy machine needs the margin.
LONGEST_S = 30
SETTINGS = {"path": "raster", "pitch_mm": 4, "step_mm": 4, "plan_joint": False}


def the_lines_of_the_readme():
    (lines,) = [block for block in README.read_text("utf-8").split("```")[1::2] if "planish.plan(" in block]
    lines = lines.strip().splitlines()
    assert len(lines) == 5, lines
    write()
    begun = time.monotonic()
    exec("\n".join(lines), {})
    took = time.monotonic() - begun
    print(f"the five lines of python/README.md: {took:.0f} s, {pathlib.Path('mirror.dmc').stat().st_size} bytes of a Galil program")
    assert took <= LONGEST_S, took


def from_arrays_to_a_program():
    surface, tool = (tuple(of.values()) for of in arrays())
    stages = []
    begun = time.monotonic()
    plan = planish.plan(surface, tool, MACHINE, progress=stages.append, **SETTINGS)
    program = plan.program("galil")
    print(f"from arrays to a program: {time.monotonic() - begun:.0f} s, {len(stages)} stages")
    assert stages[-1].endswith("planish verdict"), stages
    assert plan.negative is None and plan.method == "pvt+refined" and "pvt" in plan.methods, plan.methods
    assert "pvt+refined runs on lab" in repr(plan)
    # The residual is what the heights leave without the removal, pixel by pixel; and its RMS is that of the report.
    assert np.array_equal(plan.residual_nm, plan.height_nm - plan.removal_nm)
    # Below: rounding of sums over the pixels in another order, and the last bit of a number in JSON.
    assert np.isclose(plan.residual_nm.std(), plan.rms_nm, rtol=1e-12)
    assert np.isclose(plan.trajectory["break_time_s"][-1], plan.time_s, rtol=1e-12)
    assert len(plan.dwell_s) == len(plan.tool_path["dwell_point_mm"])
    # The program is that of the stage by itself.
    planish.export.galil(trajectory=plan.trajectory, machine=plan.path / "machine/machine.json", out="by-itself.galil")
    assert program.read_text() == open("by-itself.galil").read()
    check(plan.trajectory.path, [str(program)])
    assert "<html" in plan.report().read_text("utf-8")
    pictures(plan)
    folder = plan.path
    residual = plan.residual_nm
    del plan
    gc.collect()
    assert not folder.exists(), "the temporary directory outlives its plan"
    return residual


def pictures(plan):
    figure = plan.plot()
    assert [axes.get_title() for axes in figure.axes[:2]][1].startswith("Predicted residual")
    own, ax = matplotlib.pyplot.subplots()
    assert plan.plot(ax=ax) is own and ax.get_title().startswith("Predicted residual")
    for axes in (*figure.axes[:2], ax):
        low, high = axes.collections[0].get_clim()
        assert low == -high < 0 and axes.get_aspect() == 1, (low, high, axes.get_aspect())
    page = plan._repr_html_()
    assert all(f"<td>{method}" in page for method in plan.methods) and f"{plan.rms_nm:.4g}" in page, page
    maps = plan.to_xarray()
    assert np.array_equal(maps.residual_nm, maps.height_nm - maps.removal_nm) and maps.residual_nm.attrs["units"] == "nm"
    assert np.array_equal(maps.x, plan.x_mm) and maps.y.attrs["units"] == "mm" and maps.attrs["rms_nm"] == plan.rms_nm
    table = plan.table()
    assert list(table.index) == plan.methods and table.rms_nm[plan.method] == plan.rms_nm, table


def stages_take_and_give_arrays():
    surface, tool = (tuple(of.values()) for of in arrays())
    mirror = {"surface": surface, "tif": tool}
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always")
        path = planish.toolpath.raster(**mirror, pitch_mm=4, step_mm=4)
    # The doubt is about the pitch; that arrays have no manifest is none.
    assert [(doubt.category, "pitch" in str(doubt.message)) for doubt in doubts] == [(planish.PlanishWarning, True)], doubts
    dwell = planish.dwell.bounded_least_squares(**mirror, tool_path=path, min_dwell_s=0.05)
    motion = planish.schedule.pvt(tool_path=path, dwell=dwell, machine=MACHINE)
    # A machine may take longer than the dwell times, never less; both are sums of the same doubles in another order.
    assert motion["break_time_s"][-1] >= dwell["dwell_s"].sum() * (1 - 1e-12)
    folder = path.path
    # The same by files, byte by byte: the artifacts do not tell where the arrays came from.
    planish.save("as-files", height_nm=surface[0], x_mm=surface[1], y_mm=surface[2])
    same = planish.toolpath.raster(surface="as-files", tif="tool", pitch_mm=4, step_mm=4, out="path-of-files")
    assert np.array_equal(same["point_mm"], path["point_mm"])
    # Neither a flag, nor a temporary folder, nor a command line
    unsaid = ("--", "/planish-", "planish ")
    refused(lambda: planish.toolpath.raster(**mirror, pitch_mm=-4, step_mm=4), planish.PlanishError, "pitch_mm", unsaid)
    refused(
        lambda: planish.schedule.pvt(tool_path=path, dwell=dwell, machine={"axes": []}), planish.PlanishError, "machine",
        (*unsaid, "machine.json"),
    )
    refused(lambda: planish.toolpath.raster(surface=surface[0], tif=tool, pitch_mm=4), TypeError, "as (map, x, y)")
    del path, dwell, motion
    gc.collect()
    assert not folder.exists(), "the temporary directory outlives its artifact"


def xarray_in_and_out(residual):
    height, x, y = arrays()[0].values()
    rate, dx, dy = arrays()[1].values()
    # Its dimensions in the other order: a map is told by their names.
    surface = xarray.DataArray(height.T, dims=("x", "y"), coords={"x": x, "y": y}, name="height_nm", attrs={"units": "nm"})
    tool = xarray.DataArray(rate, dims=("dy", "dx"), coords={"dx": dx, "dy": dy})
    plan = planish.plan(surface, tool, MACHINE, out="kept", export="galil", **SETTINGS)
    found = plan.residual_nm
    assert found.dims == ("y", "x") and found.attrs["units"] == "nm" and found.x.attrs["units"] == "mm"
    # With a program, the report recommends what the controller will run; the plan below it is the same as before.
    assert plan.method == "pvt+refined+galil"
    before = planish.load("kept/run/methods/pvt+refined/removal")["residual_nm"]
    assert np.array_equal(before, residual)
    assert plan.program("galil", out="again.galil").read_text() == (plan.path / "program.galil").read_text()
    for wrong in (surface.assign_attrs(units="um"), surface.assign_coords(x=("x", x, {"units": "m"}))):
        refused(lambda: planish.plan(wrong, tool, MACHINE), ValueError, "is in '")
    return found


def maps_as_files(residual):
    values = np.array(residual)
    values[3, 5] = np.nan
    surface = (values, residual.x.values, residual.y.values)
    for name in ("residual.fits", "residual.h5"):
        planish.save_map(name, surface)
        back = planish.import_.surface(name, out=f"back-{name}")
        assert np.array_equal(back["height_nm"], values, equal_nan=True), name
        # A FITS header has a first coordinate and a step; the last coordinate is 75 mm.
        for axis, of in (("x_mm", surface[1]), ("y_mm", surface[2])):
            assert np.abs(back[axis] - of).max() <= 75 * 2**-50, name
        refused(lambda: planish.save_map(name, surface), FileExistsError, "is there")
    planish.save_map("other.h5", residual)
    kept = planish.plan("mirror", "tool", "machine.json", out="kept-arrays", **SETTINGS)
    planish.save_map("plan.fits", kept, "residual_nm")
    assert np.array_equal(planish.import_.surface("plan.fits", out="back-plan")["height_nm"], kept.residual_nm)
    refused(lambda: planish.save_map("residual.tif", surface), ValueError, "give .h5, .hdf5 or .fits")
    uneven = (values, surface[1] ** 3, surface[2])
    refused(lambda: planish.save_map("uneven.fits", uneven), ValueError, "uniform lattice")


def messages_of_the_programs():
    surface, tool = (tuple(of.values()) for of in arrays())
    for call, error, said in (
        (lambda: planish.plan(surface, tool, MACHINE, "zigzag"), planish.PlanishError, "no pipeline 'zigzag'"),
        (lambda: planish.plan(surface, tool, MACHINE, "raster", pich_mm=2), planish.PlanishError, "no setting 'pich_mm'"),
        (lambda: planish.plan(surface, tool, MACHINE, "raster", pitch_mm=-2), planish.PlanishError, "pitch"),
        (lambda: planish.plan(surface[::-1], tool, MACHINE), ValueError, "there are"),
        (lambda: planish.plan((surface[0].T, *surface[1:]), tool, MACHINE), ValueError, "transpose the map"),
        (lambda: planish.plan(surface[0], tool, MACHINE), TypeError, "as (map, x, y)"),
        (lambda: planish.plan(surface, tool, {"axes": []}), planish.PlanishError, "machine"),
    ):
        refused(call, error, said)


def refused(call, error, said, unsaid=()):
    try:
        call()
    except error as e:
        assert said in str(e), f"{said!r} is not in: {e}"
        assert not any(words in str(e) for words in unsaid), e
    else:
        raise AssertionError(f"{said}: was not refused")


if __name__ == "__main__":
    warnings.simplefilter("ignore", UserWarning)
    the_lines_of_the_readme()
    messages_of_the_programs()
    stages_take_and_give_arrays()
    maps_as_files(xarray_in_and_out(from_arrays_to_a_program()))
    print("plans from arrays are as they should be")
    sys.exit(0)
