//! A small plan: a raster of twelve lines, each in pieces of its own feed, over a map with a round corner.

use ndarray::Array2;
use planish_tolerance::error_budget::{ErrorBudget, ErrorBudgetFile};
use planish_types::{Axis, Grid, Surface, Tif, Trajectory, TrajectoryBuilder};
use serde_json::Value;

/// 20 x 12 mm in pixels of 0.25 mm.
pub fn desired() -> Surface {
    let axis = |n| Axis::new(0.0, 0.25, n).unwrap();
    let grid = Grid { x: axis(81), y: axis(49) };
    let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (x, y) = (grid.x.at(c), grid.y.at(r));
        let cut = x + y > 28.0;
        if cut {
            f64::NAN
        } else {
            20.0 + 4.0 * (0.4 * x).sin() + 3.0 * (0.5 * y).cos() + 0.05 * x * y
        }
    });
    Surface::new(grid, height).unwrap()
}

/// A Gaussian of 1 mm out to 5 mm.
#[allow(dead_code)] // the tests of a tool that varies have one of their own
pub fn tif() -> Tif {
    let axis = Axis::new(-5.0, 0.25, 41).unwrap();
    let grid = Grid { x: axis, y: axis };
    let rate = |(r, c): (usize, usize)| {
        let (x, y): (f64, f64) = (axis.at(c), axis.at(r));
        8.0 * (-(x * x + y * y) / 2.0).exp()
    };
    Tif::new(grid, Array2::from_shape_fn(grid.shape(), rate)).unwrap()
}

/// Lines 1 mm apart from 4 mm before the map to 4 mm beyond, in pieces of 1 mm whose time follows the map.
pub fn raster() -> Trajectory {
    let mut motion = TrajectoryBuilder::default();
    for line in 0..19 {
        let y = f64::from(line) - 3.0;
        for k in 0..28 {
            let (from, to) = if line % 2 == 0 { (k, k + 1) } else { (28 - k, 27 - k) };
            let (from, to) = (f64::from(from) - 4.0, f64::from(to) - 4.0);
            let x = 0.5 * (from + to);
            let height = 20.0 + 4.0 * (0.4 * x).sin() + 3.0 * (0.5 * y).cos() + 0.05 * x * y;
            // Height times the area of the piece over the volumetric removal rate 2 pi 8
            let h = (height / 50.3).max(0.05);
            let index = Some(motion.len());
            motion.push(h, [[from, (to - from) / h, 0.0, 0.0], [y, 0.0, 0.0, 0.0]], true, index);
        }
        // Beyond the map, to the next line.
        let x = if line % 2 == 0 { 24.0 } else { -4.0 };
        motion.push(0.2, [[x, 0.0, 0.0, 0.0], [y, 5.0, 0.0, 0.0]], true, None);
    }
    motion.build().unwrap()
}

/// The process of a file.
#[allow(dead_code)] // the tests of the program write the file
pub fn process(file: &Value) -> Result<ErrorBudget, String> {
    let file: ErrorBudgetFile = serde_json::from_value(file.clone()).map_err(|e| e.to_string())?;
    file.checked().map_err(|e| e.to_string())
}
