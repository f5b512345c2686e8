"""A controller whose rules planish does not know, for docs/how-to/identify-a-controller.md.

    hidden-controller.py OUT

Writes OUT/test-motion.gcode, a program of lines at one speed with many turns, and OUT/log.csv, what the controller makes
of it: positions every millisecond with noise of 1 um. The rules are those of the constants below, in small steps of time.
"""

import math
import pathlib
import random
import sys

LAG_S = 0.008
SMOOTHING_S = 0.02
# Change of the velocity that passes a corner, mm/s, and acceleration beside it, mm/s^2.
CORNER_MM_PER_S = 4.0
ACCELERATION_MM_PER_S2 = 400.0
CLOCK = 1.0002
NOISE_MM = 0.001
SPEED_MM_PER_S = 20.0
LINE_MM = 10.0
STEP_S = 5e-5
BEFORE_S, AFTER_S = 0.7313, 0.5
TURNS = [0.4, 2.2, 0.9, 3.0, 1.4, 2.6, 0.2, 1.9, 2.9, 0.7, 1.2, 2.4, 3.1, 0.5, 1.7, 2.1] * 3


def corners():
    heading, points = 0.3, [(0.0, 0.0)]
    for turn in TURNS:
        x, y = points[-1]
        points.append((round(x + LINE_MM * math.cos(heading), 6), round(y + LINE_MM * math.sin(heading), 6)))
        heading += turn
    return points


def speeds_at_corners(points, lengths):
    """The speed at every corner: a turn by b lets d / (2 sin(b/2)) pass, and the lines leave room for the ramps."""
    heading = [math.atan2(q[1] - p[1], q[0] - p[0]) for p, q in zip(points, points[1:])]
    speeds = [CORNER_MM_PER_S]
    for before, after in zip(heading, heading[1:]):
        speeds.append(min(SPEED_MM_PER_S, CORNER_MM_PER_S / (2 * abs(math.sin((after - before) / 2)))))
    speeds.append(CORNER_MM_PER_S)
    for k in range(1, len(speeds)):
        speeds[k] = min(speeds[k], math.sqrt(speeds[k - 1] ** 2 + 2 * ACCELERATION_MM_PER_S2 * lengths[k - 1]))
    for k in reversed(range(len(speeds) - 1)):
        speeds[k] = min(speeds[k], math.sqrt(speeds[k + 1] ** 2 + 2 * ACCELERATION_MM_PER_S2 * lengths[k]))
    return speeds


def planned(points):
    """Positions of the planner at steps of time: every line with a ramp up, full speed, and a ramp down."""
    lengths = [math.dist(p, q) for p, q in zip(points, points[1:])]
    speeds = speeds_at_corners(points, lengths)
    positions, time = [], 0.0
    for p, q, length, first, last in zip(points, points[1:], lengths, speeds, speeds[1:]):
        a = ACCELERATION_MM_PER_S2
        top = min(SPEED_MM_PER_S, math.sqrt((first**2 + last**2) / 2 + a * length))
        up, down = (top - first) / a, (top - last) / a
        full = (length - (first + top) / 2 * up - (top + last) / 2 * down) / top
        total = up + full + down
        while time < total:
            left = total - time
            if time < up:
                s = first * time + a * time**2 / 2
            elif time < up + full:
                s = (first + top) / 2 * up + top * (time - up)
            else:
                s = length - last * left - a * left**2 / 2
            positions.append([p[i] + s / length * (q[i] - p[i]) for i in (0, 1)])
            time += STEP_S
        time -= total
    return positions


def followed(command):
    """The axes: the moving average of the command, then a lag of first order."""
    window, rest = round(SMOOTHING_S / STEP_S), round((SMOOTHING_S + AFTER_S) / STEP_S)
    command = [command[0]] * window + command + [command[-1]] * rest
    decay = math.exp(-STEP_S / LAG_S)
    sums = [sum(p[i] for p in command[: window + 1]) for i in (0, 1)]
    before = axis = list(command[0])
    positions = []
    for k in range(window, len(command) - 1):
        # By the trapezoidal rule
        ends = [(command[k - window][i] + command[k][i]) / 2 for i in (0, 1)]
        average = [(sums[i] - ends[i]) / window for i in (0, 1)]
        middle = [(before[i] + average[i]) / 2 for i in (0, 1)]
        axis = [middle[i] + decay * (axis[i] - middle[i]) for i in (0, 1)]
        before = average
        positions.append(axis)
        sums = [sums[i] + command[k + 1][i] - command[k - window][i] for i in (0, 1)]
    return positions


def main():
    out = pathlib.Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    points = corners()
    lines = [f"G1 X{x} Y{y} F{60 * SPEED_MM_PER_S:g}" for x, y in points[1:]]
    head = ["G21 G90 G17 G94", "G61", f"G0 X{points[0][0]} Y{points[0][1]}"]
    (out / "test-motion.gcode").write_text("\n".join([*head, *lines, "M2"]) + "\n")
    positions, noise = followed(planned(points)), random.Random(67)
    rows, k = ["time_s,x_mm,y_mm"], 0
    while True:
        time = max(0.0, (k * 0.001 - BEFORE_S) / CLOCK) / STEP_S
        if time + 2 > len(positions):
            break
        p, q, f = positions[int(time)], positions[int(time) + 1], time % 1
        x, y = (p[i] + f * (q[i] - p[i]) + noise.gauss(0, NOISE_MM) for i in (0, 1))
        rows.append(f"{k * 0.001:.3f},{x:.6f},{y:.6f}")
        k += 1
    (out / "log.csv").write_text("\n".join(rows) + "\n")


main()
