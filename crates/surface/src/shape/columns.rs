//! Heights of a map column by column, or measured slopes, as input of the fit of a [`super::curve::Curve`].
//!
//! The squares of a column are those of its mean, with the weight of its pixels, and those of the
//! deviations from the mean. Only the tilt along y can reduce the latter. So a curve over a million pixels
//! is a problem of some thousand rows.

use super::{Heights, NM_PER_MM};

/// Means over the columns of a map, or the measured slopes of a profile.
#[derive(Default)]
pub(super) struct Columns {
    /// Positions of the columns along x, mm.
    pub x_mm: Vec<f64>,
    /// Mean height of each column, mm, or measured slope, rad.
    pub mean_mm: Vec<f64>,
    /// Square root of the number of valid pixels of each column; empty for slopes, which have the weight 1.
    pub weight: Vec<f64>,
    /// Mean y of the valid pixels of each column, from the middle of y, mm; empty for slopes.
    pub y_mm: Vec<f64>,
    /// Middle of the y of the map, mm.
    pub y_middle_mm: f64,
    /// Square root S of the sum of (y - mean y)^2 within the columns, mm, and the sum of (y - mean y)(z - mean z) over
    /// S, mm. `None` if the pixels do not determine a tilt along y.
    pub within: Option<[f64; 2]>,
}

impl Columns {
    /// Returns the means over the columns that have valid pixels.
    pub fn of_map(heights: &Heights) -> Self {
        let y = heights.y_mm;
        let mut columns = Self { y_middle_mm: 0.5 * (y[0] + y[y.len() - 1]), ..Self::default() };
        let mut yy = 0.0;
        let mut yz = 0.0;
        for (c, column) in heights.height_nm.columns().into_iter().enumerate() {
            let valid = column.iter().zip(y).filter(|(z, _)| !z.is_nan());
            let mut n = 0.0;
            let mut z_sum = 0.0;
            let mut y_sum = 0.0;
            for (z, y) in valid.clone() {
                n += 1.0;
                z_sum += z;
                y_sum += y - columns.y_middle_mm;
            }
            if n == 0.0 {
                continue;
            }
            let z_mean = z_sum / n;
            let y_mean = y_sum / n;
            for (z, y) in valid {
                let y = y - columns.y_middle_mm - y_mean;
                yy += y * y;
                yz += y * (z - z_mean);
            }
            columns.x_mm.push(heights.x_mm[c]);
            columns.mean_mm.push(z_mean / NM_PER_MM);
            columns.weight.push(f64::sqrt(n));
            columns.y_mm.push(y_mean);
        }
        if y.len() > 1 && yy > 0.0 {
            columns.within = Some([yy.sqrt(), yz / yy.sqrt() / NM_PER_MM]);
        }
        columns
    }

    /// Returns every n-th column, with n so that fewer than twice `count` remain; all if they are few. Starts of a fit
    /// are compared on them.
    pub fn thinned(&self, count: usize) -> Self {
        let step = (self.x_mm.len() / count).max(1);
        let [x_mm, mean_mm, weight, y_mm] = [&self.x_mm, &self.mean_mm, &self.weight, &self.y_mm]
            .map(|all| all.iter().step_by(step).copied().collect());
        Self { x_mm, mean_mm, weight, y_mm, ..*self }
    }

    /// Returns true if the columns contain heights, false if they contain slopes.
    pub fn are_heights(&self) -> bool {
        !self.weight.is_empty()
    }

    /// Returns true if the pixels determine a tilt along y.
    pub fn has_y(&self) -> bool {
        self.within.is_some()
    }
}
