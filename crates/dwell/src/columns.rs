//! The removal model of the dwell solvers: what one second at each dwell point removes.
//!
//! ```text
//! point columns    B_ij = R(x_i - d_j)                                   the tool sits at d_j
//! segment columns  B_ij = sum_q w_q R(x_i - p_j - s_q (p_{j+1} - p_j))   it moves uniformly
//! executed columns B_ij = sum_q w_q R(x_i - P_j(u_q h_j))                it moves as scheduled
//! ```
//!
//! with the three-point Gauss rule along the chord of segment j, or in time along each piece of the
//! trajectory that serves it. R is the interpolated TIF of
//! [`planish_types::Tif`]. This model is the solver's own; what the machine really does is
//! predicted elsewhere, by code that shares nothing with it.

use ndarray::{Array2, ArrayView1, s};
use planish_numerics::{keys, quadrature::gauss_legendre};
use planish_types::{Axis, Grid, Tif, ToolPath, Trajectory};
use rayon::prelude::*;
use serde::Serialize;

/// What a dwell time is spent on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Columns {
    /// Standing at the dwell point.
    Point,
    /// Moving uniformly along the segment.
    Segment,
}

/// The tool is at `position_mm` for this part of a dwell time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// Position [x, y], mm.
    pub position_mm: [f64; 2],
    /// Part of the dwell time; those of a column sum to 1.
    pub part: f64,
}

impl Columns {
    /// Where the tool is in each column; nowhere when it is lifted.
    pub fn places(self, path: &ToolPath) -> Vec<Vec<Place>> {
        let rule = gauss_legendre::<3>();
        let column = |j: usize| match self {
            _ if !path.tool_on()[j] => Vec::new(),
            Self::Point => vec![Place { position_mm: path.dwell_point_mm()[j], part: 1.0 }],
            Self::Segment => {
                let (start, d) = (path.point_mm()[j], path.displacement_mm(j));
                let at = |s: f64| [start[0] + s * d[0], start[1] + s * d[1]];
                rule.map(|(s, part)| Place { position_mm: at(s), part }).to_vec()
            }
        };
        (0..path.len()).map(column).collect()
    }
}

/// Where the tool is in each of `columns` columns of an executed motion: a three-point Gauss rule in
/// time on every piece that serves the column with the tool on.
pub fn executed(trajectory: &Trajectory, columns: usize) -> Vec<Vec<Place>> {
    let rule = gauss_legendre::<3>();
    let mut places = vec![Vec::new(); columns];
    for segment in trajectory.segments().filter(|s| s.tool_on) {
        let Some(column) =
            usize::try_from(segment.dwell_index).ok().and_then(|j| places.get_mut(j))
        else {
            continue;
        };
        column.extend(rule.map(|(u, w)| Place {
            position_mm: segment.position_mm(u * segment.duration_s),
            part: w * segment.duration_s,
        }));
    }
    for column in &mut places {
        let total: f64 = column.iter().map(|p| p.part).sum();
        column.iter_mut().for_each(|p| p.part /= total);
    }
    places
}

/// One column of B: a rectangle of pixels, zero elsewhere.
#[derive(Clone, Debug)]
pub struct Patch {
    /// First pixel row and column.
    pub origin: (usize, usize),
    /// nm/s, possibly empty.
    pub rate_nm_per_s: Array2<f64>,
}

/// B by columns; empty patches where the tool is nowhere.
pub fn patches(places: &[Vec<Place>], tif: &Tif, grid: &Grid) -> Vec<Patch> {
    places.par_iter().map(|places| patch(places, tif, grid)).collect()
}

fn nowhere() -> Patch {
    Patch { origin: (0, 0), rate_nm_per_s: Array2::zeros((0, 0)) }
}

/// `sum_q w_q R(x_i - p_q)` on the pixels that any of the places reaches.
pub(crate) fn patch(places: &[Place], tif: &Tif, grid: &Grid) -> Patch {
    let reach = |axis: usize, map: &Axis, tif: &Axis| {
        let covered = places.iter().filter_map(|p| pixels(p.position_mm[axis], map, tif));
        covered.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    };
    let (Some(x), Some(y)) = (reach(0, &grid.x, &tif.grid().x), reach(1, &grid.y, &tif.grid().y))
    else {
        return nowhere();
    };
    let mut rate_nm_per_s = Array2::zeros((y.1 - y.0 + 1, x.1 - x.0 + 1));
    for Place { position_mm: p, part: w } in places {
        let along_x = weights(p[0], &grid.x, &tif.grid().x, x);
        let along_y = weights(p[1], &grid.y, &tif.grid().y, y);
        for (r, wy) in along_y.iter().enumerate() {
            let Some((iy, wy)) = wy else { continue };
            // Interpolate along y once per row, then along x.
            let g = tif.with_ghosts().slice(s![*iy..*iy + 4, ..]);
            let row = combine(&g, wy);
            let mut out = rate_nm_per_s.row_mut(r);
            for (out, wx) in out.iter_mut().zip(&along_x) {
                if let Some((ix, wx)) = wx {
                    let g = &row[*ix..*ix + 4];
                    *out += w * (wx[0] * g[0] + wx[1] * g[1] + wx[2] * g[2] + wx[3] * g[3]);
                }
            }
        }
    }
    Patch { origin: (y.0, x.0), rate_nm_per_s }
}

fn combine(rows: &ndarray::ArrayView2<f64>, w: &[f64; 4]) -> Vec<f64> {
    let [a, b, c, d]: [ArrayView1<f64>; 4] = [0, 1, 2, 3].map(|k| rows.row(k));
    (0..a.len()).map(|i| w[0] * a[i] + w[1] * b[i] + w[2] * c[i] + w[3] * d[i]).collect()
}

/// First and last pixel whose offset from `p` is within the samples of the TIF.
fn pixels(p: f64, map: &Axis, tif: &Axis) -> Option<(usize, usize)> {
    let at = |d: f64| (p + d - map.start_mm()) / map.step_mm();
    let first = (at(tif.start_mm()) - keys::SNAP).ceil().max(0.0);
    let last = (at(tif.end_mm()) + keys::SNAP).floor().min((map.len() - 1) as f64);
    (first <= last).then_some((first as usize, last as usize))
}

/// For each pixel in `range`: the first TIF node (with ghosts) and Keys' weights; `None` outside.
fn weights(
    p: f64,
    map: &Axis,
    tif: &Axis,
    range: (usize, usize),
) -> Vec<Option<(usize, [f64; 4])>> {
    (range.0..=range.1)
        .map(|i| {
            let (node, f) = keys::split((map.at(i) - p - tif.start_mm()) / tif.step_mm());
            let last = tif.len() as isize - 1;
            match node {
                _ if node == last && f == 0.0 => Some((tif.len() - 2, keys::weights(1.0))),
                _ if (0..last).contains(&node) => Some((node as usize, keys::weights(f))),
                _ => None,
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rough() -> (Tif, Grid) {
        let g =
            Grid { x: Axis::new(-1.3, 0.11, 23).unwrap(), y: Axis::new(-0.9, 0.09, 17).unwrap() };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.at(c), g.y.at(r));
            5.0 + 2.0 * x - y + (37.0 * x).sin() * (29.0 * y).cos()
        });
        let map =
            Grid { x: Axis::new(0.0, 0.1, 40).unwrap(), y: Axis::new(0.0, 0.08, 30).unwrap() };
        (Tif::new(g, rate).unwrap(), map)
    }

    #[test]
    fn a_patch_is_the_tif_at_pixel_minus_tool() {
        let (tif, map) = rough();
        for p in [[1.7, 1.3], [-1.0, 0.2], [3.9, 2.32], [0.0, 0.0], [99.0, 0.0]] {
            let patch = patch(&[Place { position_mm: p, part: 1.0 }], &tif, &map);
            let mut full = Array2::zeros(map.shape());
            let (r, c) = patch.origin;
            let (ny, nx) = patch.rate_nm_per_s.dim();
            full.slice_mut(s![r..r + ny, c..c + nx]).assign(&patch.rate_nm_per_s);
            for ((r, c), v) in full.indexed_iter() {
                let expected = tif.rate_at(map.x.at(c) - p[0], map.y.at(r) - p[1]);
                assert!((v - expected).abs() < 1e-12, "{p:?} at {r} {c}: {v} {expected}");
            }
        }
    }

    #[test]
    fn segment_columns_average_along_the_chord() {
        let (tif, map) = rough();
        let path =
            ToolPath::new(vec![[1.0, 1.0], [1.4, 1.2]], vec![[9.0, 9.0]], vec![true], vec![0])
                .unwrap();
        let p = &patches(&Columns::Segment.places(&path), &tif, &map)[0];
        let q = 0.5 - 0.15_f64.sqrt();
        let at = |s: f64, r: usize, c: usize| {
            tif.rate_at(map.x.at(c) - 1.0 - 0.4 * s, map.y.at(r) - 1.0 - 0.2 * s)
        };
        for (r, c) in [(12, 10), (20, 17), (3, 5)] {
            let expected =
                (5.0 * at(q, r, c) + 8.0 * at(0.5, r, c) + 5.0 * at(1.0 - q, r, c)) / 18.0;
            let found = p.rate_nm_per_s[[r - p.origin.0, c - p.origin.1]];
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        }
    }

    #[test]
    fn executed_columns_average_in_time_along_the_motion() {
        // x = u^2 in [0, 1]: the mean of x^2 in time is 1/5 of (1)^2, of a uniform motion 1/3.
        let c = [[0.0, 0.0, 1.0, 0.0], [2.0, 0.0, 0.0, 0.0]];
        let t = Trajectory::new(vec![0.0, 1.0, 1.5], vec![c, c], vec![true, false], vec![0, 1])
            .unwrap();
        let places = executed(&t, 2);
        let mean = |f: fn(f64) -> f64| -> f64 {
            places[0].iter().map(|p| p.part * f(p.position_mm[0])).sum()
        };
        assert!((mean(|_| 1.0) - 1.0).abs() < 1e-14);
        assert!((mean(|x| x * x) - 0.2).abs() < 1e-14);
        assert!(places[1].is_empty(), "lifted");
    }

    #[test]
    fn a_lifted_tool_removes_nothing() {
        let (tif, map) = rough();
        let path = ToolPath::through(vec![[1.0, 1.0], [1.4, 1.2]], vec![false], vec![0]).unwrap();
        assert_eq!(patches(&Columns::Segment.places(&path), &tif, &map)[0].rate_nm_per_s.len(), 0);
    }
}
