//! Size of the cells (squares of pixels) and pitch of the splines of the surrogates. The energy of the TIF is the
//! integral of its square.

use planish_types::{Grid, Tif};

use crate::model::columns::ToolPlace;

/// Largest fraction of the energy of the TIF that the cells may lose if the surrogate H~ is factorised. The side of a
/// cell is then at most 0.24 of the width of the TIF. Larger: larger cells, and more corrections by the exact gradient.
/// Smaller: smaller cells, and more time per factorisation.
pub const MAX_LOSS_FACTORISED: f64 = 5e-3;

/// Largest fraction of the energy of the narrowest TIF that the cells may lose in a problem of several tools. Wide
/// columns cover many cells, and their products take most of the time, so that it is larger than for one tool. Larger:
/// larger cells, and more corrections by the exact gradient. Smaller: smaller cells, and more time for the products.
pub const MAX_LOSS_SEVERAL: f64 = 1e-2;

/// Loss that sets the cells of the two-level method, as a fraction of the energy of the TIF. The method samples its
/// cells and loses nothing of this; the number sets the distance of the samples, 0.17 of the width of the TIF.
/// Larger: fewer samples. Smaller: more samples, and more time per product.
pub const MAX_LOSS_TWO_LEVEL: f64 = 2.5e-3;

/// Loss that sets the cells for gradient steps, as a fraction of the energy of the TIF; their distance is 0.49 of the
/// width of the TIF. It is larger than for the two-level method because products with H~ take most of the time there.
pub const MAX_LOSS_GRADIENT: f64 = 2e-2;

/// Largest number of pixels along the side of a cell. Larger: larger cells for tools that are wide in pixels.
/// Smaller: more cells, and more time.
const MAX_CELL_PIXELS: usize = 16;

/// Pitch of the splines as a multiple of the width of the TIF `(<R^2> / <|grad R|^2>)^1/2` (sigma of a Gaussian).
/// Larger: a smaller Cholesky factor of their matrix, and more steps of conjugate gradients. Smaller: the reverse.
/// Chosen by the time that problems took.
const SPLINE_PITCH_OVER_TIF_WIDTH: f64 = 0.8;

/// Largest pitch of the splines, as a multiple of the width of the TIF, to which it is raised so that the matrix of the
/// splines is factorised quickly. Beyond it, conjugate gradients take several times as many steps to find the part that
/// wider splines cannot represent.
const MAX_SPLINE_PITCH_OVER_TIF_WIDTH: f64 = 1.0;

/// Factor by which the pitch of the splines grows in each trial until their Cholesky factor is small enough. Larger:
/// the pitch overshoots more. Smaller: more trials.
const WIDENED_BY: f64 = 1.05;

/// Smallest pitch of the splines as a multiple of the mean spacing of the columns. With many more splines than
/// columns, the splines are dependent and their matrix is singular to rounding. Larger: coarser splines than the TIF
/// needs. Smaller: singular matrices.
const MIN_SPLINE_PITCH_OVER_SPACING: f64 = 1.5;

/// Largest length of a column, as a multiple of the pitch of the splines, for which a spline can include the column.
/// Larger: splines represent long columns badly. Smaller: fewer columns take part in the coarse solution.
const MAX_COLUMN_OVER_SPLINE_PITCH: f64 = 2.0;

/// Number of elements of the Cholesky factor of the matrix of the splines up to which the pitch is not widened: the
/// factorisation takes seconds. Larger: longer factorisations. Smaller: wider splines, and more conjugate gradients.
const QUICK_SPLINE_FACTOR_ELEMENTS: f64 = 1.6e8;

/// Largest number of elements of the Cholesky factor of the matrix of the splines (2.8 GB at 4 bytes each, twice that
/// during the factorisation); with more there are no splines. Larger: more memory. Smaller: more problems without the
/// two-level method.
const MAX_SPLINE_FACTOR_ELEMENTS: f64 = 7e8;

/// Returns the side of the cells, in pixels of the map, at most [`MAX_CELL_PIXELS`]. It is the largest that loses at
/// most the fraction `max_loss` of the energy of the TIF, or 1 if two pixels lose more.
pub fn cell_size(tif: &Tif, map: &Grid, max_loss: f64) -> usize {
    let [along_x, along_y] = tif.slope_energy_per_mm2();
    let hx = map.x.step_mm();
    let hy = map.y.step_mm();
    let sizes = (2..=MAX_CELL_PIXELS).rev();
    // s^2 h^2 / 12 <|grad R|^2> / <R^2>
    let mut small_loss = sizes
        .filter(|s| (s * s) as f64 * (hx * hx * along_x + hy * hy * along_y) / 12.0 <= max_loss);
    small_loss.next().unwrap_or(1)
}

/// Returns the larger of the extents of the places of a column along x and y, mm; 0 for a column without places.
pub fn length_mm(places: &[ToolPlace]) -> f64 {
    let (low, high) = extent(places.iter().map(|p| &p.position_mm));
    (high[0] - low[0]).max(high[1] - low[1]).max(0.0)
}

/// Returns the mask of the reached columns whose length is at most [`MAX_COLUMN_OVER_SPLINE_PITCH`] times the pitch of
/// the splines.
pub fn are_short(places: &[Vec<ToolPlace>], reached: &[bool], pitch_mm: f64) -> Vec<bool> {
    places
        .iter()
        .zip(reached)
        .map(|(places, reached)| {
            *reached && length_mm(places) <= MAX_COLUMN_OVER_SPLINE_PITCH * pitch_mm
        })
        .collect()
}

/// Returns the pitch of the splines, mm: fine enough for what the TIF resolves, unless the reached columns are too
/// sparse for it. `None` if at most half of the reached columns are short enough for it, or if the Cholesky factor of
/// their matrix would be too large. The size of the factor depends on the area under the reached columns, not on their
/// number.
pub fn spline_pitch(places: &[Vec<ToolPlace>], reached: &[bool], tif: &Tif) -> Option<f64> {
    let of_reached = places.iter().zip(reached).filter(|(_, reached)| **reached).map(|(p, _)| p);
    let (size_mm, least_mm) = least_pitch_mm(of_reached);
    let pitch_mm = affordable_pitch(width_mm(tif), size_mm, tif.grid().size_mm())?.max(least_mm);
    let short = count(&are_short(places, reached, pitch_mm));
    if short * 2 > count(reached) { Some(pitch_mm) } else { None }
}

/// Counts the true elements of a mask.
fn count(mask: &[bool]) -> usize {
    mask.iter().filter(|is_set| **is_set).count()
}

/// Returns true if the columns with places are so far apart that the splines over them must be wider than the TIF
/// resolves. The conjugate gradients then take many steps.
pub fn are_sparse(places: &[Vec<ToolPlace>], tif: &Tif) -> bool {
    let (_, least_mm) = least_pitch_mm(places.iter().filter(|places| !places.is_empty()));
    least_mm > SPLINE_PITCH_OVER_TIF_WIDTH * width_mm(tif)
}

/// Returns the width `(<R^2> / <|grad R|^2>)^1/2` of a TIF R, mm: sigma of a Gaussian.
fn width_mm(tif: &Tif) -> f64 {
    let [along_x, along_y] = tif.slope_energy_per_mm2();
    1.0 / (along_x + along_y).sqrt()
}

/// Returns the size [x, y] of the rectangle that contains the places of the columns, mm, and the least pitch of splines
/// that the mean spacing of the columns allows, mm.
fn least_pitch_mm<'a>(places: impl Iterator<Item = &'a Vec<ToolPlace>> + Clone) -> ([f64; 2], f64) {
    let count = places.clone().count();
    let (low, high) = extent(places.flatten().map(|p| &p.position_mm));
    let size_mm = [high[0] - low[0], high[1] - low[1]];
    let spacing_mm = (size_mm[0] * size_mm[1] / count as f64).sqrt();
    (size_mm, MIN_SPLINE_PITCH_OVER_SPACING * spacing_mm)
}

/// Returns the least pitch of splines, mm, whose matrix is factorised quickly. If none up to
/// [`MAX_SPLINE_PITCH_OVER_TIF_WIDTH`] is, returns the largest pitch of the trials; `None` if its Cholesky factor is
/// too large. `width_mm` is the width of the TIF. `size_mm` and `tif_mm` are the sizes [x, y] of the rectangle of the
/// columns and of the TIF.
fn affordable_pitch(width_mm: f64, size_mm: [f64; 2], tif_mm: [f64; 2]) -> Option<f64> {
    let mut pitch_mm = SPLINE_PITCH_OVER_TIF_WIDTH * width_mm;
    while spline_factor_elements(pitch_mm, size_mm, tif_mm) > QUICK_SPLINE_FACTOR_ELEMENTS
        && WIDENED_BY * pitch_mm <= MAX_SPLINE_PITCH_OVER_TIF_WIDTH * width_mm
    {
        pitch_mm *= WIDENED_BY;
    }
    let elements = spline_factor_elements(pitch_mm, size_mm, tif_mm);
    if elements <= MAX_SPLINE_FACTOR_ELEMENTS { Some(pitch_mm) } else { None }
}

/// Estimates the number of elements of the Cholesky factor of the matrix of the splines, which are numbered along the
/// axis that gives the narrower band. `size_mm` and `tif_mm` are as in [`affordable_pitch`].
fn spline_factor_elements(pitch_mm: f64, size_mm: [f64; 2], tif_mm: [f64; 2]) -> f64 {
    let [x, y] = size_mm.map(|v| v / pitch_mm + 4.0);
    let reach_mm = spline_reach_mm(tif_mm, pitch_mm);
    let across_x = (reach_mm[0] / pitch_mm + 4.0).min(x);
    let across_y = (reach_mm[1] / pitch_mm + 4.0).min(y);
    x * y * (across_x * y).min(across_y * x)
}

/// Estimates the number of multiplications of a Cholesky factorisation of the normal matrix of all columns. The width
/// of its band is the number of columns within the size of the TIF along one axis; the axis with fewer counts.
pub fn factorisation_work(places: &[Vec<ToolPlace>], tif: &Tif) -> f64 {
    let n = places.len() as f64;
    let (low, high) = extent(places.iter().flatten().map(|p| &p.position_mm));
    let [x, y] =
        [0, 1].map(|axis| (tif.grid().size_mm()[axis] / (high[axis] - low[axis])).min(1.0));
    n * (n * x.min(y)).powi(2)
}

/// Returns the largest distance [x, y], mm, of two splines whose removals overlap, for a TIF of the size `tif_mm` [x,
/// y].
pub fn spline_reach_mm(tif_mm: [f64; 2], pitch_mm: f64) -> [f64; 2] {
    tif_mm.map(|size| size + 4.0 * pitch_mm)
}

/// Returns the least and the largest coordinates [x, y] of some points; infinite and reversed if there are none.
pub fn extent<'a>(points: impl Iterator<Item = &'a [f64; 2]>) -> ([f64; 2], [f64; 2]) {
    let start = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    points.fold(start, |(low, high), p| {
        ([low[0].min(p[0]), low[1].min(p[1])], [high[0].max(p[0]), high[1].max(p[1])])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splines_are_wider_over_a_larger_part_and_none_over_one_that_is_too_large() {
        let (width_mm, tif_mm) = (1.5, [8.0; 2]);
        let over_width = |size_mm: f64| {
            affordable_pitch(width_mm, [size_mm; 2], tif_mm).map(|pitch| pitch / width_mm)
        };
        // The elements of the factor are as the cube of the side of a square.
        let at_100_mm = over_width(100.0).unwrap();
        // Rounding of a cube root.
        assert!((at_100_mm / SPLINE_PITCH_OVER_TIF_WIDTH - 1.0).abs() < 1e-12);
        let wider = [300.0, 500.0].map(|size_mm| over_width(size_mm).unwrap());
        assert!(at_100_mm < wider[0] && wider[0] < wider[1], "{wider:?}");
        assert!(wider[1] <= MAX_SPLINE_PITCH_OVER_TIF_WIDTH, "{wider:?}");
        assert_eq!(over_width(600.0), None);
    }
}
