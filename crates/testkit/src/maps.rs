//! Random maps, and the difference of two maps.

use std::ops::Range;

use ndarray::Array2;
use planish_types::{Axis, Grid, Surface};
use proptest::{collection, prelude::*};

/// Pixel of [`random_aperture`], mm. Another value changes the extent of the maps in mm, and the waves per
/// pixel.
const PIXEL_MM: f64 = 0.5;

/// Largest |a - b|; NaN if one of the values is NaN, so that no bound holds.
pub fn largest_difference<'a>(
    a: impl IntoIterator<Item = &'a f64>,
    b: impl IntoIterator<Item = &'a f64>,
) -> f64 {
    largest_magnitude(a.into_iter().zip(b).map(|(a, b)| a - b))
}

/// Largest magnitude; NaN if one value is. (`f64::max` would ignore it.)
pub fn largest_magnitude(values: impl IntoIterator<Item = f64>) -> f64 {
    values
        .into_iter()
        .map(f64::abs)
        .fold(0.0, |largest, v| if largest.is_nan() || v <= largest { largest } else { v })
}

prop_compose! {
    /// Wavy maps of `pixels` by `pixels` of 0.5 mm with blobs and holes, from nearly full to nearly
    /// empty; one pixel always stays.
    pub fn random_aperture(pixels: Range<usize>)(
        nx in pixels.clone(),
        ny in pixels.clone(),
        blobs in {
            let size = PIXEL_MM * pixels.end as f64;
            collection::vec((0.0..size, 0.0..size, 0.3..0.4 * size, any::<bool>()), 0..8)
        },
        base in any::<bool>(),
        keep in (0.0..1.0_f64, 0.0..1.0_f64),
    ) -> Surface {
        let axis = |n| Axis::new(0.0, PIXEL_MM, n).unwrap();
        let grid = Grid { x: axis(nx), y: axis(ny) };
        let kept = ((keep.1 * ny as f64) as usize, (keep.0 * nx as f64) as usize);
        let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
            let inside = blobs.iter().fold(base, |inside, (bx, by, radius, fill)| {
                if (x - bx).hypot(y - by) <= *radius { *fill } else { inside }
            });
            let height_nm = (0.3 * x).sin() + 2.0 * (0.4 * y).cos();
            if inside || (r, c) == kept { height_nm } else { f64::NAN }
        });
        Surface::new(grid, height).unwrap()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_near_nan() {
        assert_eq!(largest_difference(&[1.0, 2.0, 2.0], &[1.5, 5.0, 2.0]), 3.0);
        for at in 0..3 {
            let mut a = [1.0; 3];
            a[at] = f64::NAN;
            assert!(largest_difference(&a, &[2.0; 3]).is_nan());
        }
    }
}
