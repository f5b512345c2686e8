//! Small values of the stored types, and `.npy` files written by hand, for the tests.
#![allow(dead_code)] // every test file uses a part

use std::{fs, path::Path};

use ndarray::{Array2, array};
use planish_handoff::{Artifact, flags::OutputArgs};
use planish_types::{
    Axis, AzimuthWeights, Grid, PixelFactor, Removal, Surface, Tif, TimeFactor, ToolPath,
    Trajectory, TurnWeights, VaryingTif,
};

/// Returns a grid of 2 rows and 3 columns whose coordinates are exact in binary.
pub fn grid() -> Grid {
    Grid { x: Axis::new(-0.5, 0.5, 3).unwrap(), y: Axis::new(10.0, 0.25, 2).unwrap() }
}

pub fn surface() -> Surface {
    let map = array![[1.5, f64::NAN, -0.0], [1e-310, -2.0, 1e12]];
    Surface::new(grid(), map).unwrap()
}

pub fn tif() -> Tif {
    Tif::new(grid(), array![[1.0, 2.0, 0.5], [0.0, -0.01, 3.0]]).unwrap()
}

/// Returns a tool with two kernels that turn; `factors` adds factors of the pixels and of the time.
pub fn varying(factors: bool) -> Tif {
    let azimuth_deg = vec![10.0, 130.0, 250.0];
    let rows = vec![vec![1.0, 1.5, 0.75], vec![0.0, 0.25, -0.25]];
    Tif::varying(VaryingTif {
        offsets: grid(),
        kernels: vec![tif().rate_nm_per_s().clone(), array![[0.5, 0.0, 0.25], [0.0, 0.25, -0.5]]],
        positions: grid(),
        weights: vec![Array2::ones((2, 3)), Array2::from_elem((2, 3), 0.5)],
        azimuth: Some(AzimuthWeights::new([0.25, -3.0], azimuth_deg, rows).unwrap()),
        heading: factors.then(|| {
            let rows = vec![vec![1.0, 0.5], vec![0.5, 1.0]];
            TurnWeights::by_heading(vec![0.0, 180.0], rows).unwrap()
        }),
        pixels: factors
            .then(|| PixelFactor { grid: grid(), factor: Array2::from_elem((2, 3), 1.25) }),
        time: factors.then(|| TimeFactor { time_s: vec![0.0, 9.0], factor: vec![1.0, 0.5] }),
    })
    .unwrap()
}

pub fn tool_path() -> ToolPath {
    ToolPath::new(
        vec![[0.0, 0.0], [1.0, 0.1], [2.0, -0.1], [2.0, 5.0]],
        vec![[0.4, 0.1], [1.6, 0.0], [2.0, 3.0]],
        vec![true, false, true],
        vec![0, 0, -7],
    )
    .unwrap()
}

pub fn trajectory() -> Trajectory {
    let c = [[0.1, 0.2, 0.3, 0.4], [-1.0, 1e-20, 3.0, 1e9]];
    Trajectory::new(
        vec![0.0, 0.25, 7.0],
        vec![c, [c[1], c[0]]],
        vec![true, false],
        vec![Some(4), None],
    )
    .unwrap()
}

pub fn removal() -> Removal {
    Removal::new(&surface(), Array2::from_elem((2, 3), 0.75)).unwrap()
}

pub fn output(out: &Path) -> OutputArgs {
    OutputArgs { out: out.to_path_buf(), force: false, wall_time: None }
}

/// Writes `value` as a new artifact in `dir`.
pub fn write<T: Artifact>(dir: &Path, value: &T) {
    planish_handoff::save(dir, value).unwrap();
}

/// Writes only the arrays of `value`, without a manifest.
pub fn write_bare<T: Artifact>(dir: &Path, value: &T) {
    fs::create_dir_all(dir).unwrap();
    for (def, array) in T::KIND.arrays.iter().zip(value.to_arrays()) {
        fs::write(dir.join(format!("{}.npy", def.name)), array.to_npy()).unwrap();
    }
}

pub fn doubles(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

pub fn longs(values: &[i64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// Returns a `.npy` file of version 1 with this dtype, order, shape (Python text) and elements.
pub fn npy(descriptor: &str, fortran: bool, shape: &str, data: &[u8]) -> Vec<u8> {
    let order = if fortran { "True" } else { "False" };
    let header =
        format!("{{'descr': '{descriptor}', 'fortran_order': {order}, 'shape': {shape}, }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

pub fn save_f8(dir: &Path, name: &str, shape: &str, values: &[f64]) {
    fs::write(dir.join(format!("{name}.npy")), npy("<f8", false, shape, &doubles(values))).unwrap();
}
