"""Files of other people's writers, read by planish-import to the last bit they hold.

    python interop.py PLANISH_IMPORT DIR      writes the files into DIR, reads them, compares
    python interop.py --seeds DIR             writes map.h5 and map.datx, the seeds of tests/files.rs

Needs numpy, scipy, h5py, astropy, prysm, gwyfile: `just test-interop` makes a virtual environment with them.
"""

import json
import pathlib
import struct
import subprocess
import sys

import gwyfile
import h5py
import numpy as np
from astropy.io import fits
from prysm import io as prysm
from scipy import io as scipy

from writers import NO_DATA, WAVELENGTH, write_datx

def write_metropro(path, raw, pitch_m, wavelength, scale, resolution, sign):
    """A MetroPro .dat of format 1 without intensity."""
    rows, columns = raw.shape
    header = bytearray(834)
    struct.pack_into(">IHI", header, 0, 0x881B036F, 1, 834)
    struct.pack_into(">HHI", header, 68, columns, rows, 4 * rows * columns)
    struct.pack_into(">fff", header, 164, scale, wavelength, 0.0)
    struct.pack_into(">fff", header, 176, 1.0, 1.0, pitch_m)
    struct.pack_into(">h", header, 218, resolution)
    struct.pack_into(">h", header, 232, sign)
    path.write_bytes(bytes(header) + raw.astype(">i4").tobytes())


class Check:
    """Runs the importer and compares what it wrote."""

    def __init__(self, program, folder):
        self.program, self.folder, self.count = program, folder, 0

    def read(self, name, method, flags, code=0):
        out = self.folder / f"{name}.{method}"
        command = [self.program, method, name, *flags.split(), "--out", out.name, "--force"]
        run = subprocess.run(command, cwd=self.folder, capture_output=True, text=True)
        assert run.returncode == code, f"{command}: {run.returncode}\n{run.stdout}{run.stderr}"
        return out, run.stderr

    def same(self, name, expected, flags="", array="height_nm", method="surface", pitch=None):
        out, _ = self.read(name, method, flags)
        found = np.load(out / (array + ".npy"))
        assert found.shape == expected.shape, f"{name}: {found.shape} for {expected.shape}"
        assert np.array_equal(found, expected, equal_nan=True), (
            f"{name}: differs by {np.nanmax(np.abs(found - expected))}"
        )
        if pitch is not None:
            x, y = np.load(out / "x_mm.npy"), np.load(out / "y_mm.npy")
            step = [np.diff(x).mean(), np.diff(y).mean()]
            # The mean of differences of coordinates up to 30 mm.
            assert np.allclose(step, pitch, rtol=1e-12), f"{name}: pitch {step}"
        manifest = json.loads((out / "manifest.json").read_text())
        assert manifest["outcome"]["reading"]["invalid"] == int(np.isnan(expected).sum()), name
        self.count += 1


def their_datx(path):
    """prysm takes the first surface by name, whatever the links say."""
    with h5py.File(path, "r+") as f:
        del f["/Data/Surface/Other"]
    return prysm.read_zygo_datx(path)["phase"]


def maps():
    """A map without symmetry, in m; with holes; and its coordinates in m."""
    rng = np.random.default_rng(1)
    z = 1e-7 * rng.standard_normal((37, 53)) + 1e-6 * np.linspace(0, 1, 53)
    holed = z.copy()
    holed[3:6, 40:] = np.nan
    return z, holed, 2e-4 * np.arange(53), 5e-4 * np.arange(37)


def compare(program, folder):
    check = Check(program, folder)
    z, holed, x, y = maps()
    grid = "--pixel-mm 0.2,0.5"

    for name, array in {
        "f8": holed,
        "f4": holed.astype("<f4"),
        "big": holed.astype(">f8"),
        "fortran": np.asfortranarray(holed),
        "i2": (1e9 * z).astype("<i2"),
    }.items():
        np.save(folder / f"{name}.npy", array)
        unit = "nm" if name == "i2" else "m"
        factor = 1.0 if name == "i2" else 1e9
        check.same(f"{name}.npy", array.astype(float) * factor, f"--unit {unit} {grid}")
    check.same("f8.npy", holed[::-1] * 1e9, f"--unit m {grid} --first-row top")
    check.same("f8.npy", np.rot90(holed, -1) * 1e9, f"--unit m {grid} --rotate-deg 90")
    check.same("f8.npy", holed[:, ::-1] * -0.5e9, f"--unit m {grid} --flip-x --negate --surface-per-value 0.5")

    np.savetxt(folder / "map.csv", holed, fmt="%.17g", delimiter=",")
    check.same("map.csv", holed * 1e9, f"--unit m {grid}")
    xx, yy = np.meshgrid(x, y)
    points = np.c_[xx.ravel(), yy.ravel(), z.ravel()]
    np.random.default_rng(2).shuffle(points)
    np.savetxt(folder / "points.xyz", points, fmt="%.17g")
    check.same("points.xyz", z * 1e9, "--unit m --coordinate-unit m", pitch=[0.2, 0.5])

    for compressed in (False, True):
        name = f"compressed-{compressed}.mat"
        tif = np.exp(-(xx - x[26]) ** 2 / 1e-6 - (yy - y[18]) ** 2 / 3e-6) * 1e-8
        content = {"X": xx, "Y": yy[::-1], "Z": holed[::-1], "t": np.arange(5.0), "s": "text"}
        content |= {"Xtif": x - x[26], "Ytif": y - y[18], "Ztif": tif, "c": {"a": 1}}
        scipy.savemat(folder / name, content, do_compression=compressed)
        units = "--unit m --coordinate-unit m"
        # Y descends, so the rows come back in the order of the map.
        check.same(name, holed * 1e9, units, pitch=[0.2, 0.5])
        check.same(name, tif * 1e9, units + " --rate", "rate_nm_per_s", "tif", [0.2, 0.5])
        # The coordinates of Z do not belong to Ztif, though they are as many.
        check.same(name, tif * 1e9, units + " --dataset Ztif", pitch=[0.2, 0.5])

    for name, options in {
        "plain": {},
        "gzip": {"chunks": (8, 16), "compression": "gzip", "shuffle": True},
        "checked": {"chunks": (37, 53), "fletcher32": True},
    }.items():
        for version in ("earliest", "latest"):
            path = folder / f"{name}-{version}.h5"
            with h5py.File(path, "w", libver=version) as f:
                d = f.create_dataset("a/b/height", data=holed * 1e6, **options)
                d.attrs["unit"] = "um"
                f["a/x"], f["a/y"] = x * 1e3, y * 1e3
            flags = "--dataset /a/b/height --x /a/x --y /a/y --coordinate-unit mm"
            check.same(path.name, (holed * 1e6) * 1e3, flags, pitch=[0.2, 0.5])
            check.same(path.name, (holed * 1e6) * 1e3, grid)
    with h5py.File(folder / "huge.h5", "w") as f:
        f.create_dataset("z", shape=(65536, 65536), dtype="f8", chunks=(64, 64))
    _, said = check.read("huge.h5", "surface", "--unit nm --pixel-mm 1", code=2)
    assert "claims 65536 rows x 65536 columns" in said, said
    with h5py.File(folder / "v73.mat", "w", userblock_size=512) as f:
        for key, value in {"X": xx, "Y": yy, "Z": holed}.items():
            f.create_dataset(key, data=value.T).attrs["MATLAB_class"] = np.bytes_("double")
    with open(folder / "v73.mat", "r+b") as f:
        f.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    check.same("v73.mat", holed * 1e9, "--unit m --coordinate-unit m", pitch=[0.2, 0.5])

    fringes = holed / (0.5 * WAVELENGTH)
    write_datx(folder / "fringes.datx", fringes, "Fringes", 2e-4)
    check.same("fringes.datx", (fringes * ((0.5 * 1.0 * WAVELENGTH) * 1e9))[::-1], pitch=[0.2, 0.2])
    theirs = their_datx(folder / "fringes.datx")
    # prysm multiplies in another order.
    assert np.allclose(theirs, holed * 1e9, rtol=1e-12, equal_nan=True)
    write_datx(folder / "nm.datx", holed * 1e9, "NanoMeters", 2e-4)
    check.same("nm.datx", (holed * 1e9)[::-1], pitch=[0.2, 0.2])
    write_datx(folder / "nounits.datx", holed, "NoUnits", 2e-4)
    _, said = check.read("nounits.datx", "surface", "", code=2)
    assert 'is in "NoUnits"' in said, said

    for resolution, r in enumerate((4096, 32768, 131072)):
        for sign in (0, 1):
            w = float(np.float32(WAVELENGTH))
            raw = np.round(z / (w * 0.5 / r)).astype(int)
            raw[3:6, 40:] = 2147483640
            path = folder / f"metropro-{resolution}-{sign}.dat"
            write_metropro(path, raw, 2e-4, WAVELENGTH, 0.5, resolution, sign)
            values = np.where(raw >= 2147483640, np.nan, raw.astype(float))
            nm = (-1.0 if sign else 1.0) * (w * 0.5 * 1.0 / r) * 1e9
            check.same(path.name, (values * nm)[::-1], pitch=[float(np.float32(2e-4)) * 1e3] * 2)
            theirs = prysm.read_zygo_dat(path)["phase"]
            # prysm leaves the sign word out, and multiplies in another order.
            assert np.allclose(theirs, np.abs(nm) * values, rtol=1e-12, equal_nan=True)

    # prysm writes the pitch of its ASCII files in another unit than m: it is asked for.
    prysm.write_zygo_ascii(folder / "prysm.asc", holed * 1e9, 0.2, wavelength=0.6328)
    lines = (folder / "prysm.asc").read_text().split("#\n")
    raw = np.array(lines[2].split(), dtype=float).reshape(z.shape)
    raw[raw >= 2147483640] = np.nan
    factor = 0.6328e-6 * 0.5 * 1.0 / 32768 * 1e9
    check.same("prysm.asc", (raw * factor)[::-1], "--format xyz --pixel-mm 0.2 --override-file", pitch=[0.2, 0.2])

    def header(hdu, unit):
        hdu.header["BUNIT"] = unit
        for axis, step in ((1, 2e-4), (2, 5e-4)):
            hdu.header[f"CDELT{axis}"], hdu.header[f"CUNIT{axis}"] = step, "m"
        return hdu

    # Structures of MATLAB, within each other.
    for name, compressed in (("struct.mat", True), ("struct-plain.mat", False)):
        fields = {"heights": holed, "axes": {"x": x, "y": y}, "note": "text"}
        scipy.savemat(folder / name, {"mirror": fields, "other": 1.0}, do_compression=compressed)
        flags = "--dataset mirror.heights --x mirror.axes.x --y mirror.axes.y --unit m --coordinate-unit m"
        check.same(name, holed * 1e9, flags, pitch=[0.2, 0.5])

    # A channel whose mask marks its holes, as Gwyddion leaves them.
    field = gwyfile.objects.GwyDataField(np.nan_to_num(holed), xreal=53 * 2e-4, yreal=37 * 5e-4, si_unit_xy="m", si_unit_z="m")
    marked = gwyfile.objects.GwyDataField(np.isnan(holed).astype(float), xreal=53 * 2e-4, yreal=37 * 5e-4)
    channels = gwyfile.objects.GwyContainer({"/0/data": field, "/0/data/title": "Height", "/0/mask": marked})
    channels.tofile(str(folder / "channel.gwy"))
    check.same("channel.gwy", (holed * 1e9)[::-1], pitch=[0.2, 0.5])

    header(fits.PrimaryHDU(holed * 1e9), "nm").writeto(folder / "f8.fits", overwrite=True)
    check.same("f8.fits", holed * 1e9, pitch=[0.2, 0.5])
    narrow = (holed * 1e6).astype(np.float32)
    image = header(fits.ImageHDU(narrow), "um")
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(folder / "f4.fits", overwrite=True)
    check.same("f4.fits", narrow.astype(float) * 1e3, pitch=[0.2, 0.5])
    scaled = header(fits.PrimaryHDU((1e9 * z).astype(np.int16)), "nm")
    scaled.header["BSCALE"], scaled.header["BZERO"] = 0.25, 100.0
    scaled.writeto(folder / "i2.fits", overwrite=True)
    # astropy stores what it is given; BSCALE and BZERO are ours.
    raw = fits.open(folder / "i2.fits", do_not_scale_image_data=True)[0]
    zero, scale = raw.header.get("BZERO", 0.0), raw.header.get("BSCALE", 1.0)
    check.same("i2.fits", zero + scale * raw.data.astype(float), pitch=[0.2, 0.5])

    spot(check, folder)
    print(f"{check.count} files of other writers read to the last bit")


def spot(check, folder):
    """Before and after maps of a spot become its rate."""
    x = 0.1 * (np.arange(121) - 60)
    xx, yy = np.meshgrid(x, x)
    before = 20 * np.sin(1.3 * xx) + 10 * np.cos(0.8 * yy + 0.3 * xx)
    dig = 300 * np.exp(-(xx**2 + yy**2) / 0.8)
    np.save(folder / "before.npy", before)
    np.save(folder / "after.npy", before - dig + 3 * xx - 7)
    flags = "--unit nm --pixel-mm 0.1 --dwell-s 30 --half-size-mm 3 --before before.npy"
    out, _ = check.read("after.npy", "tif", flags)
    rate, at = np.load(out / "rate_nm_per_s.npy"), np.load(out / "x_mm.npy")
    assert np.abs(rate - 10 * np.exp(-(at**2 + at[:, None] ** 2) / 0.8)).max() < 1e-3
    check.count += 1


def seeds(folder):
    """2 x 3 pixels, for the tests that have no Python."""
    raw = np.array([[1.0, -2, 3], [40, 50, -60]])
    with h5py.File(folder / "map.h5", "w") as f:
        f.create_dataset("height", data=raw).attrs["unit"] = "nm"
    raw[1, 2] = np.nan
    write_datx(folder / "map.datx", raw, "Fringes", 2.5e-4)


if __name__ == "__main__":
    if sys.argv[1] == "--seeds":
        seeds(pathlib.Path(sys.argv[2]))
    else:
        target = pathlib.Path(sys.argv[2])
        target.mkdir(parents=True, exist_ok=True)
        compare(pathlib.Path(sys.argv[1]).resolve(), target)
