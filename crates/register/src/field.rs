//! Heights and gradients of a map between its pixels.

use ndarray::Array2;
use planish_numerics::keys;
use planish_types::{Axis, Grid, Invalid, Surface};

/// A map that gives heights and gradients at any point whose sixteen surrounding pixels are valid.
pub(crate) struct Field {
    map: Surface,
}

impl Field {
    /// Wraps a map, so that it can be evaluated between its pixels.
    pub fn new(map: Surface) -> Self {
        Self { map }
    }

    /// Returns the pixel centres of the map.
    pub fn grid(&self) -> &Grid {
        self.map.grid()
    }

    /// Returns the valid pixels row by row: index [row, column], centre [x, y] in mm, and height in nm.
    pub fn valid_indexed(&self) -> impl Iterator<Item = ([usize; 2], [f64; 2], f64)> + '_ {
        let grid = self.grid();
        let valid = self.map.height_nm().indexed_iter().filter(|(_, z)| z.is_finite());
        valid.map(|((r, c), z)| ([r, c], [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)], *z))
    }

    /// Returns the centres [x, y] in mm and the heights in nm of the valid pixels, row by row.
    pub fn valid(&self) -> impl Iterator<Item = ([f64; 2], f64)> + '_ {
        self.valid_indexed().map(|(_, x, z)| (x, z))
    }

    /// Returns `value(centre [x, y] in mm, height in nm)` of all pixels, row by row; NaN where a pixel is invalid.
    pub fn map_values(&self, mut value: impl FnMut([f64; 2], f64) -> f64) -> Vec<f64> {
        let mut values = vec![f64::NAN; self.map.height_nm().len()];
        for ([r, c], p, z) in self.valid_indexed() {
            values[r * self.grid().x.len() + c] = value(p, z);
        }
        values
    }

    /// Returns the height (nm) and its gradient [x, y] (nm/mm) at a point [x, y] in mm, by Keys' cubic convolution.
    /// Returns `None` if one of the sixteen surrounding pixels is absent or invalid.
    pub fn height_and_gradient(&self, p: [f64; 2]) -> Option<(f64, [f64; 2])> {
        let grid = self.grid();
        let z = self.map.height_nm();
        let (ny, nx) = grid.shape();
        let (cx, fx) = cell(&grid.x, p[0])?;
        let (cy, fy) = cell(&grid.y, p[1])?;
        if cx < 1 || cy < 1 || cx + 2 >= nx as isize || cy + 2 >= ny as isize {
            return None;
        }
        let [wx, wy] = [fx, fy].map(keys::weights);
        let [vx, vy] = [fx, fy].map(slopes);
        let mut height = 0.0;
        let mut gradient = [0.0; 2];
        for b in 0..4 {
            let r = cy as usize + b - 1;
            let mut line = 0.0;
            let mut slope = 0.0;
            for a in 0..4 {
                let v = z[[r, cx as usize + a - 1]];
                line += wx[a] * v;
                slope += vx[a] * v;
            }
            height += wy[b] * line;
            gradient[0] += wy[b] * slope;
            gradient[1] += vy[b] * line;
        }
        let gradient = [gradient[0] / grid.x.step_mm(), gradient[1] / grid.y.step_mm()];
        // An invalid pixel makes all of them NaN.
        if !height.is_finite() || !gradient.iter().all(|g| g.is_finite()) {
            return None;
        }
        Some((height, gradient))
    }

    /// Returns the pixel [row, column] whose centre is nearest to the point `p` [x, y] in mm, or `None` beyond the map.
    pub fn nearest(&self, p: [f64; 2]) -> Option<[usize; 2]> {
        Some([nearest_index(&self.grid().y, p[1])?, nearest_index(&self.grid().x, p[0])?])
    }

    /// Returns the gradient [x, y] of the height by central differences at a pixel [row, column], nm/mm. Returns `None`
    /// if one of its four neighbours is absent or invalid.
    pub fn gradient(&self, [r, c]: [usize; 2]) -> Option<[f64; 2]> {
        let grid = self.grid();
        let z = self.map.height_nm();
        let (ny, nx) = grid.shape();
        if r == 0 || c == 0 || r + 1 >= ny || c + 1 >= nx {
            return None;
        }
        let g = [
            (z[[r, c + 1]] - z[[r, c - 1]]) / (2.0 * grid.x.step_mm()),
            (z[[r + 1, c]] - z[[r - 1, c]]) / (2.0 * grid.y.step_mm()),
        ];
        if g.iter().all(|g| g.is_finite()) { Some(g) } else { None }
    }
}

/// Returns the index of the last pixel at or below a coordinate, and the distance from it in pixels. Returns `None` for
/// coordinates that are not finite or 1e9 pixels away.
fn cell(axis: &Axis, mm: f64) -> Option<(isize, f64)> {
    let s = (mm - axis.start_mm()) / axis.step_mm();
    if s.is_finite() && s.abs() < 1e9 { Some(keys::split(s)) } else { None }
}

/// Returns the index of the pixel whose centre is nearest to a coordinate, or `None` beyond the axis.
fn nearest_index(axis: &Axis, mm: f64) -> Option<usize> {
    let i = ((mm - axis.start_mm()) / axis.step_mm()).round();
    if i >= 0.0 && i < axis.len() as f64 { Some(i as usize) } else { None }
}

/// Returns the derivatives of Keys' four interpolation weights with respect to `f`, the offset from the pixel below, in
/// pixels.
fn slopes(f: f64) -> [f64; 4] {
    [
        (-1.5 * f + 2.0) * f - 0.5,
        (4.5 * f - 5.0) * f,
        (-4.5 * f + 4.0) * f + 0.5,
        (1.5 * f - 1.0) * f,
    ]
}

/// Returns a map minus its Gaussian mean, so that features shorter than `wavelength_mm` remain. The Gaussian filter
/// passes one half of the amplitude at this wavelength (ISO 16610-21): `exp(-2 pi^2 s^2 / L^2) = 1/2`, with the
/// standard deviation s = 0.1874 L. Invalid pixels have no weight. Refuses a wavelength below about 2.7 pixels, and one
/// above 5.3 times the size of the map.
pub(crate) fn shorter_than(map: &Surface, wavelength_mm: f64) -> Result<Surface, Invalid> {
    let grid = map.grid();
    let sigma_mm = wavelength_mm * (0.5 * std::f64::consts::LN_2).sqrt() / std::f64::consts::PI;
    let sigma = [grid.y.step_mm(), grid.x.step_mm()].map(|step| sigma_mm / step);
    if sigma.iter().any(|s| *s < 0.5)
        || sigma[0] > grid.y.len() as f64
        || sigma[1] > grid.x.len() as f64
    {
        let problem = format!("is {wavelength_mm} mm");
        let remedy = "give some pixels at least, and less than five times the map";
        return Err(Invalid::whole("shorter_than_mm", problem, remedy));
    }
    let z = map.height_nm();
    let mut sum = z.mapv(|v| if v.is_finite() { v } else { 0.0 });
    let mut weight = z.mapv(|v| f64::from(u8::from(v.is_finite())));
    for (axis, sigma) in sigma.into_iter().enumerate() {
        sum = blurred(&sum, axis, sigma);
        weight = blurred(&weight, axis, sigma);
    }
    let short = z - &(sum / weight);
    Surface::new(*grid, short)
}

/// Returns the convolution with a Gaussian of `sigma` pixels along an axis (0: along y, 1: along x). The Gaussian is
/// cut at 4 `sigma`; its weights are not normalised.
fn blurred(map: &Array2<f64>, axis: usize, sigma: f64) -> Array2<f64> {
    let reach = (4.0 * sigma).ceil() as usize;
    let weights: Vec<f64> =
        (0..=reach).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp()).collect();
    let mut out = Array2::zeros(map.dim());
    for (from, mut to) in
        map.lanes(ndarray::Axis(axis)).into_iter().zip(out.lanes_mut(ndarray::Axis(axis)))
    {
        for i in 0..from.len() {
            let range = i.saturating_sub(reach)..(i + reach + 1).min(from.len());
            to[i] = range.map(|j| weights[i.abs_diff(j)] * from[j]).sum();
        }
    }
    out
}
