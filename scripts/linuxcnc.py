"""Runs a G-code program in LinuxCNC's simulator and records the commanded position of every servo period.

    linuxcnc.py PROGRAM MACHINE.json LOG.csv

The limits of the simulated axes are those of the machine file. The log has a line per servo period of 1 ms: time,
positions of the axes in mm or degrees, and digital output 0, which is the tool. The simulator runs
four times as fast as a machine (faster_clock.c); it needs root, for namespaces of its own.
"""

import json
import math
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

SERVO_PERIOD_S = 0.001
GAIN = 1000
# Speed of the simulator's clock, and lines in a second of this clock above which it runs in real time. Faster: the
# interpreter is too slow for the planner, which then stops.
FASTER = 4
MANY_LINES_PER_S = 200

INI = """[EMC]
VERSION = 1.1
MACHINE = planner
[DISPLAY]
DISPLAY = {home}/driver.py
[TASK]
TASK = planner-task
CYCLE_TIME = 0.001
[RS274NGC]
PARAMETER_FILE = {home}/empty.var
[EMCMOT]
EMCMOT = motmod
SERVO_PERIOD = 1000000
[HAL]
HALFILE = {home}/sim.hal
[TRAJ]
COORDINATES = {coordinates}
LINEAR_UNITS = mm
ANGULAR_UNITS = degree
DEFAULT_LINEAR_VELOCITY = {velocity}
MAX_LINEAR_VELOCITY = {velocity}
DEFAULT_LINEAR_ACCELERATION = {acceleration}
MAX_LINEAR_ACCELERATION = {acceleration}
DEFAULT_ANGULAR_VELOCITY = {velocity}
MAX_ANGULAR_VELOCITY = {velocity}
NO_FORCE_HOMING = 1
[EMCIO]
EMCIO = io
TOOL_TABLE = {home}/tool.tbl
[KINS]
KINEMATICS = trivkins coordinates={letters}
JOINTS = {joints}
"""
AXIS = """[{name}]
TYPE = {type}
MAX_VELOCITY = {velocity}
MAX_ACCELERATION = {acceleration}
MIN_LIMIT = -100000
MAX_LIMIT = 100000
FERROR = 1000
MIN_FERROR = 1000
"""
DRIVER = """#!/usr/bin/python3
import linuxcnc, subprocess, time
command, status, errors = linuxcnc.command(), linuxcnc.stat(), linuxcnc.error_channel()
def note(text):
    open("{home}/errors", "a").write(str(text) + "\\n")
for state in linuxcnc.STATE_ESTOP_RESET, linuxcnc.STATE_ON:
    command.state(state)
    command.wait_complete()
command.mode(linuxcnc.MODE_AUTO)
command.wait_complete()
sampler = subprocess.Popen(["halsampler", "-t"], stdout=open("{home}/samples", "w"))
time.sleep(0.3)
command.program_open("{program}")
command.wait_complete()
# The way to the start waits until the planner has its queue full: an interpreter that is too slow on a busy computer
# would stop the motion, and here it is the planner that is tried.
command.rapidrate(0.0)
command.auto(linuxcnc.AUTO_RUN, 0)
queued, still = -1, 0
while still < 10:
    time.sleep(0.2)
    status.poll()
    still = still + 1 if status.queue == queued else 0
    queued = status.queue
command.rapidrate(1.0)
time.sleep(0.5)
begun = time.time()
while time.time() - begun < {longest_s}:
    status.poll()
    error = errors.poll()
    if error:
        note(error)
    if status.interp_state == linuxcnc.INTERP_IDLE and status.inpos and status.queue == 0:
        break
    time.sleep(0.02)
else:
    note("the program has not ended")
time.sleep(0.5)
error = errors.poll()
while error:
    note(error)
    error = errors.poll()
status.poll()
if status.task_state != linuxcnc.STATE_ON:
    note("the machine is off: task state " + str(status.task_state))
sampler.terminate()
sampler.wait()
"""


def limits(axis):
    """Velocity, acceleration and type of an axis of the machine file."""
    for unit, kind in [("mm", "LINEAR"), ("deg", "ANGULAR")]:
        if f"max_velocity_{unit}_per_s" in axis:
            return axis[f"max_velocity_{unit}_per_s"], axis[f"max_acceleration_{unit}_per_s2"], kind
    sys.exit(f"axis {axis['name']}: has no velocity limit")


def write_machine(home, axes):
    """The INI and the HAL file of the simulated machine in `home`."""
    letters = [axis["name"].upper() for axis in axes]
    each = [limits(axis) for axis in axes]
    linear = [(v, a) for v, a, kind in each if kind == "LINEAR"]
    sections = []
    for k, (letter, (velocity, acceleration, kind)) in enumerate(zip(letters, each)):
        for name in (f"AXIS_{letter}", f"JOINT_{k}"):
            sections.append(AXIS.format(name=name, type=kind, velocity=velocity, acceleration=acceleration))
    # The limits of a path are those of its axes: the planner takes the smaller.
    text = INI.format(
        home=home,
        coordinates=" ".join(letters),
        letters="".join(letters),
        joints=len(axes),
        velocity=math.hypot(*(v for v, _ in linear)),
        acceleration=math.hypot(*(a for _, a in linear)),
    )
    (home / "sim.ini").write_text(text + "".join(sections))
    hal = [
        f"loadrt trivkins coordinates={''.join(letters)}",
        f"loadrt motmod servo_period_nsec=1000000 num_joints={len(axes)}",
        f"loadrt sampler depth=20000 cfg=b{'f' * len(axes)}",
        # halsampler prints six decimals: those of um and of thousandths of a degree.
        f"loadrt scale count={len(axes)}",
        "addf motion-command-handler servo-thread",
        "addf motion-controller servo-thread",
        *(f"addf scale.{k} servo-thread" for k in range(len(axes))),
        "addf sampler.0 servo-thread",
        "net tool motion.digital-out-00 => sampler.0.pin.0",
        *(f"setp scale.{k}.gain {GAIN}" for k in range(len(axes))),
        *(
            f"net p{k} joint.{k}.motor-pos-cmd => joint.{k}.motor-pos-fb scale.{k}.in"
            for k in range(len(axes))
        ),
        *(f"net s{k} scale.{k}.out => sampler.0.pin.{k + 1}" for k in range(len(axes))),
        "net estop iocontrol.0.user-enable-out => iocontrol.0.emc-enable-in",
    ]
    (home / "sim.hal").write_text("\n".join(hal) + "\n")


def run(program, machine, log, longest_s, speed=FASTER):
    """Runs `program` on the axes of the machine file `machine`; writes the samples to `log`. Returns what LinuxCNC
    reported, one message in a line."""
    axes = json.loads(pathlib.Path(machine).read_text())["axes"]
    with tempfile.TemporaryDirectory(dir=pathlib.Path(log).resolve().parent) as folder:
        home = pathlib.Path(folder)
        copy = home / "program.ngc"
        copy.write_bytes(pathlib.Path(program).read_bytes())
        done = simulate(home, axes, DRIVER.format(home=home, program=copy, longest_s=longest_s), longest_s, speed)
        if done.returncode != 0 or not (home / "samples").exists():
            sys.exit(f"linuxcnc {program}\n{done.stdout}{done.stderr}")
        write_log((home / "samples").read_text(), axes, log)
        errors = home / "errors"
        return errors.read_text() if errors.exists() else ""


def simulate(home, axes, driver, longest_s, speed):
    """Runs the simulator with these axes of a machine file in the folder `home`. `driver` is the program of its
    user, and the clock runs `speed` times as fast where a C compiler is here. Returns the process that has ended."""
    # The real-time part runs as another user than root.
    home.chmod(0o777)
    for name in ("tool.tbl", "empty.var"):
        (home / name).touch()
    write_machine(home, axes)
    # Under a name of its own: another LinuxCNC on this computer that ends kills every process called milltask.
    shutil.copy(shutil.which("milltask"), home / "planner-task")
    (home / "driver.py").write_text(driver)
    (home / "driver.py").chmod(0o755)
    environment = {**os.environ, "HOME": str(home), "RTAPI_FIFO_PATH": "/tmp/fifo", "RTAPI_UID": "65534"}
    environment["PATH"] = f"{home}:{environment['PATH']}"
    faster = faster_clock(home) if speed != 1 else None
    if faster:
        environment |= {"LD_PRELOAD": str(faster), "FASTER": str(speed)}
    # Shared memory, lock, fifo and processes of its own: a simulator that ends kills all that it sees.
    alone = ["unshare", "--ipc", "--mount", "--net", "--pid", "--fork", "--kill-child", "--mount-proc", "sh", "-c"]
    inside = f"mount -t tmpfs tmpfs /tmp && ip link set lo up; exec linuxcnc {home}/sim.ini"
    return subprocess.run([*alone, inside], env=environment, capture_output=True, text=True, timeout=longest_s + 60)


def faster_clock(home):
    """The library of faster_clock.c, built in `home`; None without a C compiler."""
    source = pathlib.Path(__file__).resolve().parent / "faster_clock.c"
    library = home / "faster_clock.so"
    built = subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", library, source, "-ldl"], capture_output=True)
    return library if built.returncode == 0 else None


def write_log(samples, axes, log):
    """The lines of halsampler as a log; refuses samples that were lost."""
    names = [axis["name"] for axis in axes]
    units = ["deg" if limits(axis)[2] == "ANGULAR" else "mm" for axis in axes]
    lines = ["time_s," + ",".join(f"{n}_{u}" for n, u in zip(names, units)) + ",tool_on"]
    first = None
    for row in samples.splitlines():
        cells = row.split()
        if "overrun" in row:
            sys.exit("halsampler lost samples: the machine is too busy")
        if len(cells) != len(axes) + 2:
            continue
        number = int(cells[0])
        first = number if first is None else first
        positions = ",".join(f"{float(cell) / GAIN:.9f}" for cell in cells[2:])
        lines.append(f"{(number - first) * SERVO_PERIOD_S:.3f},{positions},{cells[1]}")
    pathlib.Path(log).write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    program, machine, log = sys.argv[1:4]
    print(run(program, machine, log, longest_s=3600), end="")
