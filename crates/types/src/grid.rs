//! Pixel centres of maps: uniform and ascending along each axis.

use crate::Invalid;

/// Largest distance of a given coordinate from its uniform axis, relative to a step.
///
/// Larger: non-uniform maps are treated as uniform. Smaller: coordinates that passed through 32-bit
/// floats are refused; they depart by up to 5e-5 of a step (92 mm at a step of 0.09 mm). Chosen:
/// 1e-4 of a pixel is below any registration error.
const UNIFORMITY: f64 = 1e-4;

/// Largest distance of a coordinate from the origin, mm: 10 km. Farther coordinates are in another unit. Much larger:
/// products of coordinates overflow, far from the code that reads the wrong number.
const LARGEST_MM: f64 = 1e7;
/// Smallest distance between neighbouring coordinates, mm. A smaller step is a mistake in the unit,
/// or rounding.
const SMALLEST_STEP_MM: f64 = 1e-9;

/// Returns true if a coordinate is plausible in mm.
pub fn is_plausible_mm(mm: f64) -> bool {
    mm.abs() <= LARGEST_MM
}

/// Coordinates `start_mm + i step_mm`, `i = 0..len`: pixel centres along x or y.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis {
    start_mm: f64,
    step_mm: f64,
    len: usize,
}

impl Axis {
    /// Returns the axis of `len` coordinates from `start_mm` in steps of `step_mm`.
    ///
    /// # Errors
    /// Refuses fewer than 2 coordinates, coordinates beyond 1e7 mm, and steps below 1e-9 mm.
    pub fn new(start_mm: f64, step_mm: f64, len: usize) -> Result<Self, Invalid> {
        if len < 2 {
            return Err(Invalid::whole("axis", format!("{len} coordinates"), "give at least 2"));
        }
        let axis = Self { start_mm, step_mm, len };
        let plausible = is_plausible_mm(start_mm) && is_plausible_mm(axis.end_mm());
        if !(plausible && step_mm >= SMALLEST_STEP_MM) {
            return Err(Invalid::whole(
                "axis",
                format!("has the start {start_mm} mm, the step {step_mm} mm, {len} coordinates"),
                "give mm within 1e7 mm of the origin and a step of at least 1e-9 mm",
            ));
        }
        Ok(axis)
    }

    /// Returns the axis through the coordinates `mm`, which the messages call `name`.
    ///
    /// # Errors
    /// Refuses fewer than 2 coordinates, coordinates beyond 1e7 mm, and coordinates that do not ascend in equal steps
    /// (to 1e-4 of a step).
    pub fn from_coordinates(name: &'static str, mm: &[f64]) -> Result<Self, Invalid> {
        if mm.len() < 2 {
            return Err(Invalid::whole(
                name,
                format!("has {} element(s)", mm.len()),
                "give at least 2 pixel centres",
            ));
        }
        if let Some(i) = mm.iter().position(|v| !is_plausible_mm(*v)) {
            return Err(Invalid::at_index(
                name,
                i,
                format!("is {:?}", mm[i]),
                "give finite pixel centres in mm, within 1e7 mm of the origin",
            ));
        }
        if let Some(i) = (1..mm.len()).find(|&i| mm[i] <= mm[i - 1]) {
            return Err(Invalid::at_index(
                name,
                i,
                format!("is {} after {}", mm[i], mm[i - 1]),
                "coordinates must ascend; flip the axis and the map together",
            ));
        }
        let len = mm.len();
        let start_mm = mm[0];
        let step_mm = (mm[len - 1] - start_mm) / (len - 1) as f64;
        if step_mm < SMALLEST_STEP_MM {
            return Err(Invalid::whole(
                name,
                format!("has steps of {step_mm} mm"),
                "give coordinates in mm with a step of at least 1e-9 mm",
            ));
        }
        let axis = Self { start_mm, step_mm, len };
        if (0..len).any(|i| (mm[i] - axis.coordinate_mm(i)).abs() > UNIFORMITY * step_mm) {
            // A single jump displaces all coordinates from the axis between both ends. The odd step
            // tells its place.
            let mut steps: Vec<f64> = mm.windows(2).map(|w| w[1] - w[0]).collect();
            let (_, &mut median, _) = steps.select_nth_unstable_by(len / 2 - 1, f64::total_cmp);
            let deviations = mm.windows(2).map(|w| (w[1] - w[0] - median).abs());
            let (i, _) =
                (1..).zip(deviations).max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((1, 0.0));
            return Err(Invalid::at_index(
                name,
                i,
                format!(
                    "is {} after {}, a step of {} mm where the median step is {median} mm",
                    mm[i],
                    mm[i - 1],
                    mm[i] - mm[i - 1]
                ),
                "resample the map to a uniform grid",
            ));
        }
        Ok(axis)
    }

    /// Returns the coordinate of pixel `i`, mm.
    #[inline]
    pub fn coordinate_mm(&self, i: usize) -> f64 {
        self.start_mm + i as f64 * self.step_mm
    }

    /// Returns the first and smallest coordinate, mm.
    pub fn start_mm(&self) -> f64 {
        self.start_mm
    }

    /// Returns the last and largest coordinate, mm.
    pub fn end_mm(&self) -> f64 {
        self.coordinate_mm(self.len - 1)
    }

    /// Returns the outer edges of the first and the last pixel, mm.
    pub fn edges_mm(&self) -> [f64; 2] {
        let half = 0.5 * self.step_mm;
        [self.start_mm() - half, self.end_mm() + half]
    }

    /// Returns the distance between neighbouring coordinates, mm; > 0.
    pub fn step_mm(&self) -> f64 {
        self.step_mm
    }

    /// Returns the number of coordinates; at least 2.
    #[allow(clippy::len_without_is_empty)] // never empty
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns all coordinates in ascending order, mm.
    pub fn coordinates(&self) -> Vec<f64> {
        (0..self.len).map(|i| self.coordinate_mm(i)).collect()
    }

    /// Returns the part of the axis from pixel `first` to `last` inclusive. Refuses fewer than 2 pixels.
    pub fn crop(&self, first: usize, last: usize) -> Result<Self, Invalid> {
        Self::new(self.coordinate_mm(first), self.step_mm, (last + 1).saturating_sub(first))
    }
}

/// Pixel centres of a map with shape (ny, nx); row 0 is the smallest y.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// Pixel centres along a row, the x of the columns.
    pub x: Axis,
    /// Pixel centres along a column, the y of the rows.
    pub y: Axis,
}

impl Grid {
    /// Returns the numbers of rows and columns (ny, nx).
    pub fn shape(&self) -> (usize, usize) {
        (self.y.len(), self.x.len())
    }

    /// Returns the grid with all coordinates [x, y] larger by `by_mm`. Refuses coordinates beyond 1e7 mm.
    pub fn moved(&self, by_mm: [f64; 2]) -> Result<Self, Invalid> {
        let Self { x, y } = self;
        Ok(Self {
            x: Axis::new(x.start_mm + by_mm[0], x.step_mm, x.len)?,
            y: Axis::new(y.start_mm + by_mm[1], y.step_mm, y.len)?,
        })
    }

    /// Returns the distances [x, y] from the first to the last pixel centre, mm.
    pub fn size_mm(&self) -> [f64; 2] {
        [self.x, self.y].map(|axis| axis.end_mm() - axis.start_mm())
    }

    /// Returns the area of one pixel, mm^2.
    pub fn pixel_mm2(&self) -> f64 {
        self.x.step_mm() * self.y.step_mm()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_uniform_axis_comes_back() {
        let given: Vec<f64> = (0..985).map(|i| -3.0 + 0.093833 * f64::from(i)).collect();
        let axis = Axis::from_coordinates("x_mm", &given).unwrap();
        for (i, v) in given.iter().enumerate() {
            // Rounding of coordinates up to 100.
            assert!((axis.coordinate_mm(i) - v).abs() < 1e-12);
        }
    }

    #[test]
    fn coordinates_through_32_bit_floats_are_accepted() {
        let given: Vec<f64> =
            (0..985).map(|i| f64::from((0.093833 * f64::from(i)) as f32)).collect();
        assert!(Axis::from_coordinates("x_mm", &given).is_ok());
    }

    #[test]
    fn bad_axes_name_the_index_and_the_value() {
        let message = |v: &[f64]| Axis::from_coordinates("x_mm", v).unwrap_err().to_string();
        assert!(message(&[1.0]).contains("at least 2"));
        assert!(message(&[0.0, f64::NAN]).contains("x_mm[1]: is NaN"));
        assert!(message(&[0.0, 1.0, 1.0]).contains("x_mm[2]: is 1 after 1"));
        assert!(message(&[2.0, 1.0]).contains("ascend"));
        // The message names the jump, not the first departure from the axis between both ends.
        let jump = message(&[0.0, 1.0, 2.0, 3.0, 4.5, 5.5]);
        assert!(jump.contains("x_mm[4]: is 4.5 after 3, a step of 1.5 mm"), "{jump}");
        assert!(jump.contains("the median step is 1 mm"), "{jump}");
        assert!(message(&[-1e308, 1e308]).contains("x_mm[0]: is -1"));
        assert!(message(&[0.0, 1e-300]).contains("has steps of"));
    }
}
