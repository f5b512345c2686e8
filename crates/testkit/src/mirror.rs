//! The reference mirror: a flat silicon mirror and an ion beam, with published tool paths and dwell
//! times (T. Wang et al., J. Manuf. Process. 2023, doi 10.1016/j.jmapro.2023.01.005).

use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayD, Ix2};
use planish_handoff::{
    kind::Dtype,
    npy::{self, ArrayData},
};
use planish_types::{Axis, DwellTime, Grid, Surface, Tif, ToolPath};

use crate::skipped::reference;

/// The mirror, its TIF, and the folder of the other files.
pub struct Mirror {
    dir: PathBuf,
    /// Desired removal.
    pub desired: Surface,
    /// TIF of the ion beam.
    pub tif: Tif,
}

/// Reads the mirror. Returns `None`, and the test counts as skipped, if `PLANISH_REFERENCE` does not name
/// the folder that holds `nsls2-mirror/`. Panics if a file of it is missing or damaged.
pub fn mirror() -> Option<Mirror> {
    let dir = reference()?.join("nsls2-mirror");
    let desired = Surface::new(grid(&dir, ""), map(&dir, "height_nm")).unwrap();
    let tif = Tif::new(grid(&dir, "tif_"), map(&dir, "tif_nm_per_s")).unwrap();
    Some(Mirror { dir, desired, tif })
}

fn load(dir: &Path, name: &str) -> ArrayD<f64> {
    match npy::read(&dir.join(format!("{name}.npy")), Dtype::F64).unwrap().array {
        ArrayData::F64(a) => a.into_owned(),
        other => panic!("{name}: {:?}", other.dtype()),
    }
}

fn map(dir: &Path, name: &str) -> Array2<f64> {
    load(dir, name).into_dimensionality::<Ix2>().unwrap()
}

fn grid(dir: &Path, prefix: &str) -> Grid {
    let axis = |name: &'static str| {
        let mm: Vec<f64> = load(dir, &format!("{prefix}{name}")).iter().copied().collect();
        Axis::from_coordinates(name, &mm).unwrap()
    };
    Grid { x: axis("x_mm"), y: axis("y_mm") }
}

impl Mirror {
    /// The folder of its files.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// The two-dimensional array `name`.
    pub fn map(&self, name: &str) -> Array2<f64> {
        map(&self.dir, name)
    }

    fn points(&self, name: &str) -> Vec<[f64; 2]> {
        self.map(name).outer_iter().map(|p| [p[0], p[1]]).collect()
    }

    /// The published path, `raster` or `maze`; a missing last control point mirrors the one before
    /// about the last dwell point.
    pub fn path(&self, name: &str) -> ToolPath {
        let mut points = self.points(&format!("{name}_path_mm"));
        let dwell_points = self.points(&format!("{name}_dwell_point_mm"));
        let n = dwell_points.len();
        if points.len() == n {
            let (p, d) = (points[n - 1], dwell_points[n - 1]);
            points.push([2.0 * d[0] - p[0], 2.0 * d[1] - p[1]]);
        }
        ToolPath::new(points, dwell_points, vec![true; n], vec![0; n]).unwrap()
    }

    /// The published dwell times along it.
    pub fn dwell(&self, name: &str) -> DwellTime {
        let dwell_s = load(&self.dir, &format!("{name}_udo_dwell_s"));
        DwellTime::new(dwell_s.iter().copied().collect()).unwrap()
    }
}
