"""Writers of files as instruments and other programs write them, for tests in Python. Those of HDF5 need h5py."""

import struct
from pathlib import Path

import numpy as np

NO_DATA = 1.7976931348623157e308
WAVELENGTH = 632.8e-9


def write_datx(path, raw, unit, pitch_m, scale=0.5, obliquity=1.0):
    """A .datx as Zygo Mx lays it out; NaN becomes the value for no data."""
    import h5py

    text = h5py.string_dtype("ascii")
    links = [
        ("Root", "Measurement", "M"),
        ("M", "Surface", "S"),
        ("M", "Attributes", "/Attributes/A"),
        ("S", "Path", "/Data/Surface/S"),
    ]
    with h5py.File(path, "w") as f:
        table = np.zeros(4, dtype=[(n, text) for n in ("Source", "Link", "Destination")])
        for i, link in enumerate(links):
            table[i] = link
        f.create_dataset("MetaData", data=table)
        f.create_group("/Attributes/A").attrs["Data Context.Count:Value"] = np.array([1.0])
        # A second surface that nothing links to.
        f.create_dataset("/Data/Surface/Other", data=np.zeros((2, 2)))
        d = f.create_dataset("/Data/Surface/S", data=np.where(np.isnan(raw), NO_DATA, raw))
        d.attrs.create("Unit", data=np.array([unit], dtype=object), dtype=text)
        for name, value in [
            ("No Data", NO_DATA),
            ("Wavelength", WAVELENGTH),
            ("Interferometric Scale Factor", scale),
            ("Obliquity Factor", obliquity),
        ]:
            d.attrs.create(name, data=np.array([value]))
        kind = np.dtype(
            [("Category", text), ("BaseUnit", text), ("Parameters", h5py.vlen_dtype(np.float64))]
        )
        for name in ("X Converter", "Y Converter"):
            value = np.zeros(1, dtype=kind)
            value[0] = ("LateralCat", "Pixels", np.array([0, pitch_m, 0, 0]))
            d.attrs.create(name, data=value, dtype=kind)


def write_four_sight(path, waves, pitch_mm):
    """A 4Sight .h5; NaN becomes the value for no data. The first row is the top."""
    import h5py

    with h5py.File(path, "w") as f:
        group = f.create_group("measurement0/genraw")
        group.create_dataset("data", data=np.where(np.isnan(waves), 3.4028235e38, waves).astype("f4"))
        for name, value in [("wavelength", "632.8 nm"), ("xpix", f"{pitch_mm} mm"), ("height_units", "wv"), ("aspect", "1"), ("wedge", "1")]:
            group.attrs[name] = np.bytes_(value)


def write_mat(path, **arrays):
    """MATLAB version 5: each matrix of doubles, column by column."""
    def element(kind, data):
        return struct.pack("<2I", kind, len(data)) + data + bytes(-len(data) % 8)

    content = b"MATLAB 5.0 MAT-file, made by a test".ljust(124) + b"\0\1IM"
    for name, a in arrays.items():
        content += element(14, element(6, struct.pack("<2I", 6, 0)) + element(5, struct.pack("<2i", *a.shape))
                           + element(1, name.encode()) + element(9, a.astype("<f8").tobytes("F")))
    Path(path).write_bytes(content)
