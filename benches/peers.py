"""The work of the kernels by NumPy, SciPy and Clarabel, on cases of the same size: `just bench-peers`.

Removal: Keys' weights spread 8434 points on 168 x 985 pixels, one FFT convolution with a TIF of
107 x 107 pixels. Lucy-Richardson: 20 iterations by FFT. Node velocities: the quadratic program of
schedule/src/pvt.rs (4) for one axis, bounds on the velocity only. Prints a table: the least and the
median of the runs, ms; performance.py puts it beside Planish.
"""

import statistics
import time

import clarabel
import numpy as np
from scipy import fft, sparse

rng = np.random.default_rng(1)


def timed(name, work, runs=5):
    """Name, runs, least and median seconds; the first run warms up."""
    work()
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return name, runs, min(seconds), statistics.median(seconds)


def keys(f):
    return np.stack([
        ((-0.5 * f + 1) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1,
        ((-1.5 * f + 2) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    ])


def tif(n):
    x = np.linspace(-3, 3, n)
    return np.exp(-(x[:, None] ** 2 + x**2) / 2)


def removal(points, shape, n, runs=5):
    ny, nx = shape[0] + n + 2, shape[1] + n + 2
    p = rng.random((points, 2)) * [ny - 4, nx - 4] + 1
    seconds, rate = rng.random(points), tif(n)
    size = [fft.next_fast_len(ny, True), fft.next_fast_len(nx, True)]

    def work():
        cell = np.floor(p).astype(int)
        wy, wx = keys(p[:, 0] - cell[:, 0]), keys(p[:, 1] - cell[:, 1])
        index = [(cell[:, 0] + b - 1) * nx + cell[:, 1] + a - 1 for b in range(4) for a in range(4)]
        weight = [seconds * wy[b] * wx[a] for b in range(4) for a in range(4)]
        field = np.bincount(np.concatenate(index), np.concatenate(weight), ny * nx)
        spectrum = fft.rfft2(field.reshape(ny, nx), size, workers=2)
        return fft.irfft2(spectrum * fft.rfft2(rate, size, workers=2), size, workers=2)

    return timed(f"NumPy: removal, {points} resting points, {shape[0]} x {shape[1]}", work, runs)


def lucy_richardson(side, n, dtype):
    rate = tif(n)
    rate = (rate / rate.sum()).astype(dtype)
    desired = (1 + rng.random((side, side))).astype(dtype)
    size = [fft.next_fast_len(side + n - 1, True)] * 2
    spectrum, cut = fft.rfft2(rate, size, workers=2), (n - 1) // 2

    def convolve(image, kernel):
        whole = fft.irfft2(fft.rfft2(image, size, workers=2) * kernel, size, workers=2)
        return whole[cut : cut + side, cut : cut + side]

    def work():
        t = np.ones_like(desired)
        for _ in range(20):
            # the TIF is symmetric: its adjoint is the same convolution
            t *= convolve(desired / convolve(t, spectrum), spectrum)
        return t

    return timed(f"SciPy: Lucy-Richardson, 20 iterations, {side} x {side}, {np.dtype(dtype).name}", work)


def lucy_richardson_of(height_nm, rate_nm_per_s, steps, dtype):
    """Dwell times on the pixels for a map that may have invalid pixels (NaN), by `steps` steps on all tool
    positions that reach it: seconds and what is left, RMS about the mean, nm. What is desired is lifted
    like planish-dwell lucy-richardson does it: the lowest 0.1 % cut off, 2 % of the rest left everywhere."""
    start = time.perf_counter()
    valid = np.isfinite(height_nm)
    heights = np.sort(height_nm[valid])
    low, high = heights[len(heights) // 1000], heights[-1]
    weight = valid.astype(dtype)
    desired = np.where(valid, np.maximum(height_nm - low, 0) + 0.02 * (high - low), 0).astype(dtype)
    (ny, nx), (my, mx) = height_nm.shape, rate_nm_per_s.shape
    size = [fft.next_fast_len(n, True) for n in (ny + my - 1, nx + mx - 1)]
    kernel = fft.rfft2(rate_nm_per_s.astype(dtype), size, workers=2)

    def removal(t):
        return fft.irfft2(fft.rfft2(t, size, workers=2) * kernel, size, workers=2)[my - 1 : my - 1 + ny, mx - 1 : mx - 1 + nx]

    def adjoint(image):
        padded = np.zeros((ny + my - 1, nx + mx - 1), dtype)
        padded[my - 1 :, mx - 1 :] = image
        return fft.irfft2(fft.rfft2(padded, size, workers=2) * kernel.conj(), size, workers=2)[: ny + my - 1, : nx + mx - 1]

    sensitivity = adjoint(weight)
    active = sensitivity > 0.02 * sensitivity.max()
    sensitivity = np.where(active, sensitivity, 1)
    t = np.where(active, desired.sum() / sensitivity[active].sum(), 0).astype(dtype)
    for _ in range(steps):
        t *= np.where(active, adjoint(desired / np.maximum(removal(t), 1e-9)) / sensitivity, 0).astype(dtype)
    left = (height_nm - removal(t))[valid].std()
    return time.perf_counter() - start, left


def velocities(segments):
    h = 0.5 + 0.25 * np.sin(0.1 * np.arange(segments))
    dp = np.where(np.arange(segments) // 1000 % 2 == 0, 1.0, -1.0)
    main = 4 / h[:-1] + 4 / h[1:]
    g = 6 * dp[:-1] / h[:-1] ** 2 + 6 * dp[1:] / h[1:] ** 2
    off = 2 / h[1:-1]
    n = segments - 1
    hessian = sparse.triu(sparse.diags([off, main, off], [-1, 0, 1]), format="csc")
    identity = sparse.identity(n, format="csc")
    bounds = sparse.vstack([identity, -identity], format="csc")
    settings = clarabel.DefaultSettings()
    settings.verbose = False

    def work():
        cones = [clarabel.NonnegativeConeT(2 * n)]
        limit = np.full(2 * n, 250.0)
        return clarabel.DefaultSolver(2 * hessian, -2 * g, bounds, limit, cones, settings).solve()

    return timed(f"Clarabel: node velocities of one axis, {segments} segments", work)


def measure():
    return [
        removal(8434, (168, 985), 107),
        removal(250_000, (4096, 4096), 131, runs=3),
        removal(1_000_000, (8192, 8192), 131, runs=1),
        lucy_richardson(1641, 131, np.float32),
        lucy_richardson(1641, 131, np.float64),
        velocities(2678),
        velocities(62_500),
    ]


if __name__ == "__main__":
    print("| work | runs | least, ms | median, ms |\n|---|---|---|---|")
    for name, runs, least, median in measure():
        print(f"| {name} | {runs} | {1e3 * least:.1f} | {1e3 * median:.1f} |")
