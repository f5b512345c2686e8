//! The clear aperture: the region of a map in which statistics and plans count.

use ndarray::Array2;

use crate::{Grid, Invalid};

/// A region in part coordinates (mm), or a pixel mask.
#[derive(Clone, Debug, PartialEq)]
pub enum ClearAperture {
    /// Pixel centres with x in `x_mm` and y in `y_mm`, ends included.
    Rectangle {
        /// [smallest, largest] x, mm.
        x_mm: [f64; 2],
        /// [smallest, largest] y, mm.
        y_mm: [f64; 2],
    },
    /// Pixel centres at most `radius_mm` from `centre_mm`.
    Circle {
        /// Centre [x, y], mm.
        centre_mm: [f64; 2],
        /// Radius, mm; > 0.
        radius_mm: f64,
    },
    /// Mask (ny, nx) with true at the pixels in the aperture.
    Mask(Array2<bool>),
}

impl ClearAperture {
    /// Returns the aperture as a mask (ny, nx) on `grid`, true inside. Refuses an aperture that contains no pixel, ends
    /// that do not ascend, and a radius that is not positive.
    pub fn mask(&self, grid: &Grid) -> Result<Array2<bool>, Invalid> {
        // A pixel centre that rounding moves outside by up to 1e-9 of a step is inside.
        let slack = 1e-9 * grid.x.step_mm().max(grid.y.step_mm());
        let mask = match self {
            Self::Rectangle { x_mm, y_mm } => {
                for (name, [low, high]) in [("x_mm", x_mm), ("y_mm", y_mm)] {
                    if !(low.is_finite() && high.is_finite() && low < high) {
                        let problem = format!("rectangle has {name} {low}..{high}");
                        return Err(Invalid::whole(
                            "clear aperture",
                            problem,
                            "give finite min < max in mm",
                        ));
                    }
                }
                Array2::from_shape_fn(grid.shape(), |(r, c)| {
                    let x = grid.x.coordinate_mm(c);
                    let y = grid.y.coordinate_mm(r);
                    x >= x_mm[0] - slack
                        && x <= x_mm[1] + slack
                        && y >= y_mm[0] - slack
                        && y <= y_mm[1] + slack
                })
            }
            Self::Circle { centre_mm, radius_mm } => {
                if !(centre_mm.iter().all(|v| v.is_finite())
                    && radius_mm.is_finite()
                    && *radius_mm > 0.0)
                {
                    let problem =
                        format!("circle has centre {centre_mm:?} mm, radius {radius_mm} mm");
                    return Err(Invalid::whole(
                        "clear aperture",
                        problem,
                        "give a positive radius in mm",
                    ));
                }
                Array2::from_shape_fn(grid.shape(), |(r, c)| {
                    let dx = grid.x.coordinate_mm(c) - centre_mm[0];
                    let dy = grid.y.coordinate_mm(r) - centre_mm[1];
                    dx.hypot(dy) <= radius_mm + slack
                })
            }
            Self::Mask(mask) => {
                if mask.dim() != grid.shape() {
                    let problem =
                        format!("mask has shape {:?}, the map {:?}", mask.dim(), grid.shape());
                    return Err(Invalid::whole(
                        "clear aperture",
                        problem,
                        "give one value per pixel",
                    ));
                }
                mask.clone()
            }
        };
        if !mask.iter().any(|m| *m) {
            let Grid { x, y } = grid;
            return Err(Invalid::whole(
                "clear aperture",
                format!(
                    "contains no pixel of the map (x {} .. {} mm, y {} .. {} mm)",
                    x.start_mm(),
                    x.end_mm(),
                    y.start_mm(),
                    y.end_mm()
                ),
                "check its position and units",
            ));
        }
        Ok(mask)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axis;

    #[test]
    fn edges_belong_to_the_aperture() {
        let grid =
            Grid { x: Axis::new(0.0, 0.1, 11).unwrap(), y: Axis::new(0.0, 0.1, 11).unwrap() };
        let count = |a: ClearAperture| a.mask(&grid).unwrap().iter().filter(|m| **m).count();
        assert_eq!(count(ClearAperture::Rectangle { x_mm: [0.2, 0.4], y_mm: [0.0, 1.0] }), 33);
        // Radius 0.1 about the centre pixel: itself and its four neighbours.
        assert_eq!(count(ClearAperture::Circle { centre_mm: [0.5, 0.5], radius_mm: 0.1 }), 5);
        let outside = ClearAperture::Circle { centre_mm: [9.0, 9.0], radius_mm: 1.0 };
        assert!(outside.mask(&grid).unwrap_err().to_string().contains("no pixel"));
    }
}
