"""A submission to the benchmark that is made without Planish: NumPy alone.

  planish-fixture fixtures/coupon.json --out coupon          the maps of the problem, as NumPy arrays
  python3 benchmark/example/submission.py coupon submission.csv
  planish-benchmark score benchmark/problems/coupon-ion-beam-no-jerk-limit.json submission.csv

Dwell times by Richardson-Lucy steps, a raster along x, and a velocity along each line that keeps the acceleration.
"""

import sys

import numpy as np

PITCH_MM = 1.0
STEP_MM = 0.25
MAX_VELOCITY = 250.0  # mm/s, along x
ACCELERATION = [2000.0 * 0.999, 1000.0 * 0.999]  # mm/s^2, along x and y; a little below the limits
LONGEST_S = 1.0  # largest time between two rows


def dwell_map(height_nm, rate_nm_per_s, steps=200):
    """Returns seconds at every pixel of the map and of a margin around it, by Richardson-Lucy steps."""
    (ny, nx), (ky, kx) = height_nm.shape, rate_nm_per_s.shape
    shape = (ny + ky - 1, nx + kx - 1)
    spectrum = np.fft.rfft2(rate_nm_per_s, shape)

    def removal(seconds):
        return np.fft.irfft2(np.fft.rfft2(seconds) * spectrum, shape)[ky - 1 :, kx - 1 :]

    def adjoint(map_nm):
        placed = np.zeros(shape)
        placed[ky - 1 :, kx - 1 :] = map_nm
        return np.fft.irfft2(np.fft.rfft2(placed) * spectrum.conj(), shape)

    valid = ~np.isnan(height_nm)
    desired = np.where(valid, height_nm - np.nanmin(height_nm) + 1.0, 0.0)
    weight = np.maximum(adjoint(valid.astype(float)), 1e-3 * rate_nm_per_s.sum())
    seconds = np.full(shape, desired.sum() / valid.sum() / rate_nm_per_s.sum())
    for _ in range(steps):
        ratio = np.where(valid, desired / np.maximum(removal(seconds), 1e-9), 0.0)
        seconds *= np.maximum(adjoint(ratio), 0.0) / weight
    return seconds


def velocities(seconds_per_mm, step_mm, acceleration):
    """Returns velocities at the nodes of a line, mm/s: rest at both ends, and no acceleration above the limit."""
    velocity = np.minimum(1.0 / np.maximum(seconds_per_mm, 1e-9), MAX_VELOCITY)
    velocity[0] = velocity[-1] = 0.0
    for order in (range(1, len(velocity)), range(len(velocity) - 2, -1, -1)):
        for i in order:
            before = velocity[i - 1] if order.step > 0 else velocity[i + 1]
            velocity[i] = min(velocity[i], np.sqrt(before**2 + 2 * acceleration * step_mm))
    return velocity


class Motion:
    """Rows of a submission: pieces of constant acceleration, which a cubic through both ends reproduces."""

    def __init__(self, x, y):
        self.rows = [[0.0, x, y, 0.0, 0.0]]

    def move(self, axis, distance, end_velocity):
        """Moves along an axis (0 or 1) by a distance, mm, to a velocity, mm/s, with one constant acceleration."""
        t, *state = self.rows[-1]
        start, velocity = state[axis], state[axis + 2]
        duration = 2 * distance / (velocity + end_velocity)
        acceleration = (end_velocity - velocity) / duration
        parts = int(np.ceil(abs(duration) / LONGEST_S))
        for k in range(1, parts + 1):
            u = duration * k / parts
            row = list(state)
            row[axis] = start + velocity * u + 0.5 * acceleration * u * u
            row[axis + 2] = end_velocity if k == parts else velocity + acceleration * u
            self.rows.append([t + u, *row])


def main(folder, out):
    height, x, y = (np.load(f"{folder}/surface/{name}.npy") for name in ("height_nm", "x_mm", "y_mm"))
    rate, dx, dy = (np.load(f"{folder}/tif/{name}.npy") for name in ("rate_nm_per_s", "x_mm", "y_mm"))
    h = x[1] - x[0]
    seconds = dwell_map(height, rate)
    # Pixel 0 less the last offset of the tool is the first place.
    places_x = x[0] - dx[-1] + h * np.arange(seconds.shape[1])
    places_y = y[0] - dy[-1] + h * np.arange(seconds.shape[0])
    margin = 0.5 * (dx[-1] - dx[0]) * 0.6
    nodes = np.arange(x[0] - margin, x[-1] + margin + 0.5 * STEP_MM, STEP_MM)
    lines = np.arange(y[0] - margin, y[-1] + margin + 0.5 * PITCH_MM, PITCH_MM)
    motion = Motion(nodes[0], lines[0])
    for k, line in enumerate(lines):
        near = np.abs(places_y - line) <= 0.5 * PITCH_MM
        seconds_per_mm = np.interp(nodes, places_x, seconds[near].sum(0) / h)
        if k % 2:
            seconds_per_mm = seconds_per_mm[::-1]
        velocity = velocities(seconds_per_mm, STEP_MM, ACCELERATION[0])
        sign = -1.0 if k % 2 else 1.0
        for v in velocity[1:]:
            motion.move(0, sign * STEP_MM, sign * v)
        if line != lines[-1]:
            half = 0.5 * PITCH_MM
            motion.move(1, half, np.sqrt(2 * ACCELERATION[1] * half))
            motion.move(1, half, 0.0)
    with open(out, "w") as file:
        file.write("t,x,y,vx,vy\n")
        for row in motion.rows:
            file.write(",".join(repr(float(value)) for value in row) + "\n")
    print(f"{len(motion.rows)} rows, {motion.rows[-1][0]:.1f} s -> {out}")


if __name__ == "__main__":
    main(*sys.argv[1:])
