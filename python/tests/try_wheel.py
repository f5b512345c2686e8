"""What a new user does with the wheel: a mirror made with NumPy, from its arrays to programs in the machine's own axes.

    environment/bin/python try_wheel.py        in an empty directory; ends with 0 when all of it is as it should be

A mirror of 150 x 40 mm, a Gaussian tool, and a machine whose axes are exchanged and displaced. Checked are the bytes of
what a function writes against those of the command line, the program read back against the plan, and the messages.
"""

import hashlib
import importlib.metadata
import json
import os
import pathlib
import re
import subprocess
import sys
import time

import numpy as np
import planish

from mirror import MACHINE, arrays, check


def mirror():
    surface, tool = arrays()
    planish.save("mirror", **surface)
    planish.save("tool", **tool)
    pathlib.Path("machine.json").write_text(json.dumps(MACHINE))
    back = planish.load("mirror")
    assert np.array_equal(back["height_nm"], surface["height_nm"]) and back.kind is None
    # What lies under a mask is no height.
    masked = np.ma.masked_less(surface["height_nm"], 20.0)
    planish.save("masked", **{**surface, "height_nm": masked})
    stored = planish.load("masked")["height_nm"]
    assert 0 < np.isnan(stored).sum() < stored.size and np.array_equal(np.isnan(stored), masked.mask)
    assert np.array_equal(stored[~masked.mask], surface["height_nm"][~masked.mask])


def digests(folder):
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(pathlib.Path(folder).rglob("*"))
        if file.is_file()
    }


def functions_write_what_the_command_line_writes():
    made = planish.toolpath.raster(surface="mirror", tif="tool", pitch_mm=2, step_mm=2.0, out="made/path")
    assert made.kind == "tool_path" and made["point_mm"].shape[1] == 2
    dwell = planish.dwell.bounded_least_squares(
        surface="mirror", tif="tool", tool_path=made, min_dwell_s=0.02, out="made/dwell"
    )
    motion = planish.schedule.pvt(tool_path=made, dwell=dwell, machine="machine.json", out="made/trajectory")
    verdict = planish.verify(trajectory=motion, machine="machine.json", out="made/verdict")
    assert verdict.negative is None and verdict.outcome["limits_respected"], verdict.outcome
    first = digests("made")
    pathlib.Path("made").rename("by-functions")
    for command in (
        "toolpath raster --surface=mirror --tif=tool --pitch-mm=2 --step-mm=2.0 --out=made/path",
        "dwell bounded-least-squares --surface=mirror --tif=tool --tool-path=made/path --min-dwell-s=0.02 --out=made/dwell",
        "schedule pvt --tool-path=made/path --dwell=made/dwell --machine=machine.json --out=made/trajectory",
        "verify --trajectory=made/trajectory --machine=machine.json --out=made/verdict",
    ):
        program, *words = command.split()
        subprocess.run([planish.programs() / f"planish-{program}", *words], check=True, capture_output=True)
    assert digests("made") == first, "a function writes other bytes than the command line"
    print(f"functions: {len(first)} files, the bytes of the command line")
    for bands in ([0.02, 0.1], [[0.02, 0.1], [0.1, 0.5]], np.array([[0.02, 0.1], [0.1, 0.5]])):
        out = f"spectrum/{np.size(bands)}-{type(bands).__name__}"
        psd = planish.surface.psd(surface="mirror", band_per_mm=bands, out=out)
        assert np.array_equal([b["band_per_mm"] for b in psd.outcome["bands"]], np.reshape(bands, (-1, 2)))


def every_program_has_its_own_name():
    folder = planish.programs()
    for file in sorted(folder.glob("planish-*")):
        said = subprocess.run([file, "--version"], capture_output=True, text=True, check=True).stdout.split()
        assert said[0] == file.name, said
        usage = subprocess.run([file, "--help"], capture_output=True, text=True, check=True).stdout
        typed = "planish" if file.name == "planish-run" else file.name.replace("-", " ", 1)
        assert f"Usage: {typed} " in usage and f"\n  {typed} " in usage, usage
    manifest = planish.load("made/path").manifest
    assert manifest["tool"] == "planish-toolpath" and manifest["command"].startswith("planish toolpath raster "), manifest
    # By a symbolic link, as a user may put one into a folder of his PATH
    pathlib.Path("link").symlink_to(folder / "planish-run")
    subprocess.run(["./link", "--version"], capture_output=True, check=True)
    ran = subprocess.run([folder / "planish_programs", "planish-polish"], capture_output=True, text=True)
    assert ran.returncode == 2 and "unrecognized subcommand 'planish-polish'" in ran.stderr, ran.stderr


def what_is_compiled_in_is_listed():
    about = importlib.metadata.distribution("planish")
    texts = {file.name: file.read_text() for file in about.files if file.parent.name in ("licenses", "sboms")}
    bill = json.loads(texts.pop("planish.cdx.json"))
    assert bill["bomFormat"] == "CycloneDX" and len(bill["components"]) > 100
    assert sorted(texts) == ["LICENSE", "THIRD-PARTY-NOTICES.txt"]
    # The crates of others have both their licence and their place in the bill.
    for crate in bill["components"]:
        if "purl" in crate:
            assert f"\n{crate['name']} {crate['version']}\n" in texts["THIRD-PARTY-NOTICES.txt"], crate


def messages_say_what_to_do():
    for call, error, said in (
        (lambda: planish.toolpath.raster(surface="mirror", pich_mm=1), TypeError, "no argument 'pich_mm'; there are surface"),
        (lambda: planish.load("nowhere"), planish.PlanishError, "nowhere: is no directory"),
        (lambda: planish.save("made", x_mm=[1.0]), FileExistsError, "made: holds something else"),
        (lambda: planish.polish, AttributeError, "no program 'polish'; there are app, axes, benchmark"),
        (lambda: planish.toolpath.zigzag, AttributeError, "no command 'zigzag'; there are"),
        (
            lambda: planish.toolpath.raster(surface="mirror", tif="tool", pitch_mm=-1, step_mm=1, out="no"),
            planish.PlanishError,
            "pitch",
        ),
    ):
        try:
            call()
        except error as e:
            assert said in str(e), f"{e}"
        else:
            raise AssertionError(f"{said}: was not refused")
    assert "neighbouring lines, mm" in planish.toolpath.raster.__doc__
    assert {"plan", "toolpath", "import_"} <= set(dir(planish))


def distance_mm(program, plan):
    """Largest distance of a node of a program from the path of the plan, at about the same time."""
    # Each cubic as 16 chords, of which the longest lie within 0.1 um of it
    time_s, part = plan["break_time_s"], np.arange(16) / 16
    u = (part[None, :] * np.diff(time_s)[:, None]).ravel()[:, None]
    cubic = np.repeat(plan["coefficient_mm"], 16, axis=0)
    place = ((cubic[:, :, 3] * u + cubic[:, :, 2]) * u + cubic[:, :, 1]) * u + cubic[:, :, 0]
    begin, along = place[:-1], np.diff(place, axis=0)
    squared = np.maximum((along**2).sum(axis=1), 1e-30)
    near = 16 * np.searchsorted(time_s, program["break_time_s"][:-1])
    worst = 0.0
    for point, at in zip(program["coefficient_mm"][:, :, 0], near):
        piece = slice(max(0, at - 800), at + 800)
        part = np.clip(((point - begin[piece]) * along[piece]).sum(axis=1) / squared[piece], 0, 1)
        worst = max(worst, ((begin[piece] + part[:, None] * along[piece] - point) ** 2).sum(axis=1).min())
    return worst**0.5


def the_first_mirror():
    begun = time.monotonic()
    planish_command = planish.programs() / "planish"
    settings = "surface=mirror tif=tool machine=machine.json pitch_mm=2 step_mm=2 frames=0 export=galil out=first"
    ran = subprocess.run([planish_command, "run", "raster", *settings.split()], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    # Which plan the program is of; and that the report recommends it
    said = [line for line in ran.stdout.splitlines() if line.startswith("program: ")]
    assert len(said) == 2 and "the one that the report recommends" in said[1], ran.stdout + ran.stderr
    method = re.search("is of the plan ([^;]*);", said[0])[1]
    print(f"{said[0]}\n{said[1]}")
    print(f"first mirror: planned, and its program written and judged, in {time.monotonic() - begun:.0f} s")
    plan = planish.load(f"first/methods/{method}/trajectory")
    # The run planned for a copy of the machine file, with a limit on jerk.
    planish.export.gcode(trajectory=plan, machine="first/machine/machine.json", out="first/program.ngc")
    check(plan.path, ["first/program.galil", "first/program.ngc"])
    for name, controller in (("program.galil", "galil"), ("program.ngc", "gcode")):
        back = planish.import_.program(
            f"first/{name}", controller=controller, about=f"first/{name}.json", out=f"first/back-{controller}"
        )
        about = json.loads(pathlib.Path(f"first/{name}.json").read_text())
        apart = distance_mm(back, plan)
        # What the chords lose
        assert apart <= about["path_deviation_mm"] + 1e-4, f"{controller}: {apart} mm"
        longer = back["break_time_s"][-1] - plan["break_time_s"][-1] - about["added_time_s"]
        assert abs(longer) <= 2e-6, f"{controller}: {longer} s"
        print(f"{controller}: read back within {apart:.1e} mm of the path of the plan")
    shown = subprocess.run([planish_command, "show", "raster"], capture_output=True, text=True)
    assert shown.returncode == 0, shown.stdout + shown.stderr
    rows = {line.split()[0]: line.split()[1:3] for line in shown.stdout.splitlines() if line[:1].islower()}
    assert rows["setting"] == ["default", "unit"] and rows["pitch_mm"] == ["1", "mm"], shown.stdout
    assert not (pathlib.Path(planish.__file__).parent / "share/out").exists()


def the_doctor_checks_a_plan():
    doctor = [sys.executable, "-m", "planish", "doctor"]
    ran = subprocess.run(doctor, capture_output=True, text=True)
    assert ran.returncode == 0 and " nm RMS become " in ran.stdout, ran.stdout + ran.stderr
    ran = subprocess.run(doctor, capture_output=True, text=True, env={**os.environ, "PLANISH_PROGRAMS": "/nowhere"})
    assert ran.returncode == 1 and "system" in ran.stdout and "set PLANISH_PROGRAMS" in ran.stderr, ran.stdout + ran.stderr
    ran = subprocess.run([planish.programs() / "planish-run", "--version"], capture_output=True, text=True)
    version = subprocess.run([*doctor[:-1], "--version"], capture_output=True, text=True).stdout
    assert version.split()[1] == ran.stdout.split()[1], version
    ran = subprocess.run([*doctor[:-1], "polish"], capture_output=True, text=True)
    assert ran.returncode == 2 and "unrecognized subcommand 'polish'" in ran.stderr, ran.stderr


if __name__ == "__main__":
    mirror()
    functions_write_what_the_command_line_writes()
    every_program_has_its_own_name()
    what_is_compiled_in_is_listed()
    messages_say_what_to_do()
    the_doctor_checks_a_plan()
    the_first_mirror()
    print("the wheel is as it should be")
    sys.exit(0)
