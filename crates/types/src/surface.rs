//! Height maps: measured surface, desired removal, and predicted residual.

use ndarray::{Array2, Zip};
use planish_numerics::statistics::{self, Statistics};

use crate::{Grid, Invalid};

/// A height map (ny, nx) in nm; positive = material above the target; NaN = invalid pixel.
///
/// As the input of a dwell solver it is the desired removal.
#[derive(Clone, Debug)]
pub struct Surface {
    grid: Grid,
    height_nm: Array2<f64>,
    deviation_nm: Option<Array2<f64>>,
}

impl Surface {
    /// Returns the map with the heights (ny, nx), nm. Refuses another shape than that of the grid, heights beyond 1e12
    /// nm and a map without a valid pixel.
    pub fn new(grid: Grid, height_nm: Array2<f64>) -> Result<Self, Invalid> {
        check_map("height_nm", &grid, &height_nm)?;
        Ok(Self { grid, height_nm, deviation_nm: None })
    }

    /// Returns the map with the standard deviation of every height (ny, nx), nm; NaN = unknown. For a height that is
    /// the mean of several measurements, it is the standard deviation of the mean.
    ///
    /// # Errors
    /// Refuses another shape than that of the heights, and deviations below 0 or above 1e12 nm.
    pub fn with_deviation(self, deviation_nm: Array2<f64>) -> Result<Self, Invalid> {
        let name = "deviation_nm";
        if deviation_nm.dim() != self.height_nm.dim() {
            let problem = format!(
                "has shape {:?}, but height_nm has {:?}",
                deviation_nm.dim(),
                self.height_nm.dim()
            );
            return Err(Invalid::whole(name, problem, "give one deviation per pixel"));
        }
        let is_deviation = |v: f64| v.is_nan() || (0.0..=LARGEST_NM).contains(&v);
        if let Some((index, v)) = deviation_nm.indexed_iter().find(|(_, v)| !is_deviation(**v)) {
            let remedy = "give nm, from 0 to 1e12, and mark an unknown deviation by NaN";
            return Err(Invalid::at_index(name, index, format!("is {v:?}"), remedy));
        }
        Ok(Self { deviation_nm: Some(deviation_nm), ..self })
    }

    /// Returns the standard deviation of every height (ny, nx), nm, NaN = unknown, or `None` for a map without
    /// deviations.
    pub fn deviation_nm(&self) -> Option<&Array2<f64>> {
        self.deviation_nm.as_ref()
    }

    /// Returns the RMS of the known standard deviations of the valid pixels, nm: the noise level of the map. `None` if
    /// none is known.
    pub fn noise_rms_nm(&self) -> Option<f64> {
        let deviation = self.deviation_nm.as_ref()?;
        let known =
            self.height_nm.iter().zip(deviation).filter(|(z, s)| !z.is_nan() && !s.is_nan());
        let (sum, count) = known.fold((0.0, 0.0), |(sum, n), (_, s)| (sum + s * s, n + 1.0));
        if count > 0.0 { Some((sum / count).sqrt()) } else { None }
    }

    /// Returns the grid of the pixel centres.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Returns the heights (ny, nx), nm; NaN at invalid pixels.
    pub fn height_nm(&self) -> &Array2<f64> {
        &self.height_nm
    }

    /// Returns the map in the coordinates of the tool position: shifted by minus the offset `off_centre_mm` of the
    /// centre of removal ([`crate::Tif::off_centre_mm`]). A pixel then lies where the tool stands when it removes
    /// there.
    ///
    /// # Errors
    /// Refuses coordinates beyond 1e7 mm.
    pub fn seen_by_tool(&self, off_centre_mm: [f64; 2]) -> Result<Self, Invalid> {
        let grid = self.grid.moved(off_centre_mm.map(|mm| -mm))?;
        Ok(Self { grid, ..self.clone() })
    }

    /// Returns the statistics of the heights of the valid pixels, nm, such as RMS (mean removed) and PV.
    pub fn statistics(&self) -> Statistics {
        statistics::statistics(self.height_nm.view()).expect("a Surface has a valid pixel")
    }

    /// Returns the RMS after removing the least-squares plane, nm.
    pub fn detilted_rms_nm(&self) -> f64 {
        let Grid { x, y } = &self.grid;
        statistics::detilted_rms(self.height_nm.view(), &x.coordinates(), &y.coordinates())
            .expect("a Surface has a valid pixel")
    }

    /// Returns row and column of the valid pixel whose centre is nearest to `p` [x, y], mm.
    pub fn nearest_valid(&self, p: [f64; 2]) -> (usize, usize) {
        let map = &self.height_nm;
        let grid = &self.grid;
        let [c, r] = [(p[0], &grid.x), (p[1], &grid.y)].map(|(v, axis)| {
            let i = ((v - axis.start_mm()) / axis.step_mm()).round();
            i.clamp(0.0, (axis.len() - 1) as f64) as usize
        });
        if !map[[r, c]].is_nan() {
            return (r, c);
        }
        // Search in square rings of growing size, until no farther ring can contain a nearer pixel.
        let (ny, nx) = map.dim();
        let least_step = grid.x.step_mm().min(grid.y.step_mm());
        let mut best: Option<(f64, (usize, usize))> = None;
        for ring in 1..ny.max(nx) {
            let nearest_possible = (ring as f64 - 1.0) * least_step;
            if best.is_some_and(|(d2, _)| nearest_possible * nearest_possible > d2) {
                break;
            }
            let rows = r.saturating_sub(ring)..=(r + ring).min(ny - 1);
            for i in rows {
                let edge = i + ring == r || i == r + ring;
                let columns = c.saturating_sub(ring)..=(c + ring).min(nx - 1);
                for j in columns.filter(|j| edge || j + ring == c || *j == c + ring) {
                    let d2 = (grid.x.coordinate_mm(j) - p[0]).powi(2)
                        + (grid.y.coordinate_mm(i) - p[1]).powi(2);
                    if !map[[i, j]].is_nan() && best.is_none_or(|(b, _)| d2 < b) {
                        best = Some((d2, (i, j)));
                    }
                }
            }
        }
        best.expect("a surface has a valid pixel").1
    }
}

/// Predicted removal and residual of a run: `residual = desired - removal`.
#[derive(Clone, Debug)]
pub struct Removal {
    removal_nm: Array2<f64>,
    residual: Surface,
}

/// The maps of a [`Removal`] as stored, not checked yet.
#[derive(Clone, Debug, PartialEq)]
pub struct RemovalMaps {
    /// Predicted removal (ny, nx), nm; known at every pixel.
    pub removal_nm: Array2<f64>,
    /// Desired removal minus predicted removal (ny, nx), nm; NaN where the desired map is invalid.
    pub residual_nm: Array2<f64>,
}

impl Removal {
    /// Returns the removal `removal_nm` (ny, nx) and the residual that it leaves of `desired`. Refuses another shape
    /// than that of `desired`, and a removal that is NaN at any pixel, also at the invalid ones.
    pub fn new(desired: &Surface, removal_nm: Array2<f64>) -> Result<Self, Invalid> {
        let mut residual_nm = desired.height_nm().clone();
        if removal_nm.dim() == residual_nm.dim() {
            Zip::from(&mut residual_nm).and(&removal_nm).par_for_each(|z, r| *z -= r);
        }
        Self::from_maps(*desired.grid(), RemovalMaps { removal_nm, residual_nm })
    }

    /// Returns the removal with both maps, as stored. Refuses maps of another shape than that of the grid, and a
    /// removal that is NaN at any pixel.
    pub fn from_maps(grid: Grid, maps: RemovalMaps) -> Result<Self, Invalid> {
        let RemovalMaps { removal_nm, residual_nm } = maps;
        check_map("removal_nm", &grid, &removal_nm)?;
        if statistics::valid_count(removal_nm.view()) < removal_nm.len() {
            let nan = removal_nm.indexed_iter().find(|(_, v)| v.is_nan());
            let (index, _) = nan.expect("one is");
            return Err(Invalid::at_index(
                "removal_nm",
                index,
                "is NaN",
                "the removal is known everywhere",
            ));
        }
        let residual =
            Surface::new(grid, residual_nm).map_err(|e| Invalid { array: "residual_nm", ..e })?;
        Ok(Self { removal_nm, residual })
    }

    /// Returns the predicted removal (ny, nx), nm; it is known at every pixel.
    pub fn removal_nm(&self) -> &Array2<f64> {
        &self.removal_nm
    }

    /// Returns the residual as a surface: heights (ny, nx), nm; NaN where the desired map is invalid.
    pub fn residual(&self) -> &Surface {
        &self.residual
    }
}

/// Largest height, nm: one kilometre. Larger heights are a mistake in the units. Much larger:
/// squares of heights overflow.
const LARGEST_NM: f64 = 1e12;

/// Refuses a map of another shape than that of the grid, values that are too large, and a map without a valid pixel.
fn check_map(name: &'static str, grid: &Grid, map: &Array2<f64>) -> Result<(), Invalid> {
    if map.dim() != grid.shape() {
        return Err(Invalid::whole(
            name,
            format!("has shape {:?} but (y_mm, x_mm) have {:?} elements", map.dim(), grid.shape()),
            "give one row per y and one column per x",
        ));
    }
    let (low, high) = statistics::range(map.view());
    if low < -LARGEST_NM || high > LARGEST_NM {
        let too_large = map.indexed_iter().find(|(_, v)| v.abs() > LARGEST_NM);
        let (index, v) = too_large.expect("one of the two is");
        let remedy = "give nm (at most 1e12), and mark an invalid pixel by NaN";
        return Err(Invalid::at_index(name, index, format!("is {v:?}"), remedy));
    }
    if low > high {
        return Err(Invalid::whole(name, "every pixel is NaN", "give at least one valid pixel"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axis;
    use ndarray::array;

    fn grid() -> Grid {
        Grid { x: Axis::new(0.0, 1.0, 3).unwrap(), y: Axis::new(0.0, 1.0, 2).unwrap() }
    }

    #[test]
    fn residual_is_desired_minus_removal_and_keeps_nan() {
        let desired = Surface::new(grid(), array![[5.0, f64::NAN, 1.0], [2.0, 2.0, 2.0]]).unwrap();
        let r = Removal::new(&desired, Array2::from_elem((2, 3), 2.0)).unwrap();
        assert_eq!(r.residual().height_nm()[[0, 0]], 3.0);
        assert_eq!(r.residual().height_nm()[[0, 2]], -1.0);
        assert!(r.residual().height_nm()[[0, 1]].is_nan());
    }

    #[test]
    fn a_deviation_is_checked_and_its_rms_is_the_noise_level() {
        let surface = Surface::new(grid(), array![[5.0, f64::NAN, 1.0], [2.0, 2.0, 2.0]]).unwrap();
        assert!(surface.deviation_nm().is_none() && surface.noise_rms_nm().is_none());
        let with = |m: Array2<f64>| surface.clone().with_deviation(m);
        // The deviation of an invalid pixel and an unknown one do not count: sqrt((9 + 16 + 0 + 0) / 4).
        let known = with(array![[3.0, 99.0, 4.0], [0.0, f64::NAN, 0.0]]).unwrap();
        assert_eq!(known.noise_rms_nm(), Some(2.5));
        let moved = known.seen_by_tool([1.0, 0.0]).unwrap();
        assert_eq!(moved.grid().x.start_mm(), -1.0);
        assert_eq!(moved.noise_rms_nm(), Some(2.5));
        let message = with(array![[3.0, 1.0, 4.0], [0.0, -0.5, 0.0]]).unwrap_err().to_string();
        assert!(message.contains("deviation_nm[1, 1]: is -0.5"), "{message}");
        let message = with(Array2::zeros((3, 2))).unwrap_err().to_string();
        assert!(message.contains("(3, 2)") && message.contains("(2, 3)"), "{message}");
    }

    #[test]
    fn bad_maps_are_refused_with_index_and_value() {
        let message = |m| Surface::new(grid(), m).unwrap_err().to_string();
        assert!(message(Array2::zeros((3, 2))).contains("(3, 2)"));
        assert!(message(Array2::from_elem((2, 3), f64::NAN)).contains("every pixel"));
        let mut m = Array2::zeros((2, 3));
        m[[1, 2]] = f64::INFINITY;
        assert!(message(m).contains("height_nm[1, 2]: is inf"));
    }

    #[test]
    fn the_nearest_valid_pixel_is_that_of_a_full_search() {
        let grid =
            Grid { x: Axis::new(0.0, 0.5, 13).unwrap(), y: Axis::new(0.0, 0.3, 11).unwrap() };
        let map = Array2::from_shape_fn((11, 13), |(r, c)| {
            if (r * 7 + c * 5) % 11 < 2 && r > 3 { (100 * r + c) as f64 } else { f64::NAN }
        });
        let surface = Surface::new(grid, map.clone()).unwrap();
        for p in [[0.0, 0.0], [3.1, 1.4], [9.0, 9.0], [-2.0, 1.7], [2.2, 0.4]] {
            let d2 = |r: usize, c: usize| {
                (grid.x.coordinate_mm(c) - p[0]).powi(2) + (grid.y.coordinate_mm(r) - p[1]).powi(2)
            };
            let valid = map.indexed_iter().filter(|(_, v)| !v.is_nan());
            let least = valid.map(|((r, c), _)| d2(r, c)).fold(f64::INFINITY, f64::min);
            let (r, c) = surface.nearest_valid(p);
            // Rounding of squares of up to 150 mm^2.
            assert!((d2(r, c) - least).abs() < 1e-12, "{p:?}");
        }
    }
}
