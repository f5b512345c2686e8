//! Dwell times of points that the map does not decide (unreached ones): the density, dwell time per length, is
//! continued from the neighbours.
//!
//! ```text
//! q_j = (1 - w) q_a + w q_b,   w = (s_j - s_a) / (s_b - s_a),   t_j = l_j q_j                   (1)
//! ```
//!
//! with the nearest decided dwell points a and b before and after j along the path, and the path lengths s up to the
//! middles of their segments. Before the first and after the last one the density is constant. The floor in their place
//! would make the density jump where the tool leaves the map. The jump removes nothing, but the machine has to execute
//! it. A scheduler that raises all densities until its machine can follow would then be limited by that jump.
//!
//! Segments with the tool off and rests have no density, and keep their dwell times.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | s | `middle_mm` | (n) | mm |
//! | t_j / t_a, t_j / t_b | `Tie::sources` | - | 1 |

use planish_types::ToolPath;

use crate::objective::{has_density, median_length_mm};

/// One undecided dwell point. Its dwell time is the sum of `factor t_k` over its two `sources` (k, factor).
struct Tie {
    point: usize,
    sources: [(usize, f64); 2],
}

/// Rule (1) of the module for every undecided point of a path: its dwell time (a tie) is a sum of two others.
pub(crate) struct Continuation {
    ties: Vec<Tie>,
}

impl Continuation {
    /// Makes the ties of the dwell points j for which `decided(j)` is false: points that the map does not decide. Only
    /// segments with a density have ties. There are none if all or none of these are decided, or if no segment has a
    /// length.
    pub fn new(path: &ToolPath, decided: impl Fn(usize) -> bool) -> Self {
        let Some(median) = median_length_mm(path) else { return Self { ties: Vec::new() } };
        let n = path.len();
        let length: Vec<f64> = (0..n).map(|j| path.segment_length_mm(j)).collect();
        let mut middle_mm = Vec::with_capacity(n);
        let mut start_mm = 0.0;
        for length in &length {
            middle_mm.push(start_mm + 0.5 * length);
            start_mm += length;
        }
        let (known, unknown): (Vec<usize>, Vec<usize>) =
            (0..n).filter(|j| has_density(path, *j, median)).partition(|j| decided(*j));
        let (Some(&first), Some(&last)) = (known.first(), known.last()) else {
            return Self { ties: Vec::new() };
        };
        let ties = unknown.into_iter().map(|j| {
            let next = known.partition_point(|k| *k < j);
            let (a, b) = match next {
                0 => (first, first),
                k if k == known.len() => (last, last),
                k => (known[k - 1], known[k]),
            };
            // A point on either side, or the same one twice.
            let w = if a == b {
                0.0
            } else {
                (middle_mm[j] - middle_mm[a]) / (middle_mm[b] - middle_mm[a])
            };
            let sources = [(a, 1.0 - w), (b, w)].map(|(k, w)| (k, w * length[j] / length[k]));
            Tie { point: j, sources }
        });
        Self { ties: ties.collect() }
    }

    /// Sets the dwell times of the undecided points in t (n) from those of the others, by (1) of the module.
    pub fn apply(&self, t: &mut [f64]) {
        for tie in &self.ties {
            t[tie.point] = tie.sources.iter().map(|(k, factor)| factor * t[*k]).sum();
        }
    }

    /// Applies the adjoint of (1) of the module to s (n): adds the element of every undecided point, times the
    /// factors, to those of its sources.
    pub fn gather(&self, s: &mut [f64]) {
        for tie in &self.ties {
            for (k, factor) in tie.sources {
                s[k] += factor * s[tie.point];
            }
        }
    }

    /// Sets the dwell times of the undecided points in t (n) by (1) of the module, limited to their bounds `lo` and
    /// `hi` (n), s.
    pub fn apply_within(&self, t: &mut [f64], lo: &[f64], hi: &[f64]) {
        self.apply(t);
        for Tie { point, .. } in &self.ties {
            t[*point] = t[*point].max(lo[*point]).min(hi[*point]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a path of segments of 1 and 2 mm in turn along x; the tool is lifted on the sixth.
    fn path() -> ToolPath {
        let x = [0.0, 1.0, 3.0, 4.0, 6.0, 7.0, 9.0, 10.0, 12.0];
        let points = x.map(|x| [x, 0.0]).to_vec();
        let on = (0..8).map(|j| j != 5).collect();
        ToolPath::through(points, on, vec![0; 8]).unwrap()
    }

    #[test]
    fn a_linear_density_is_continued_exactly_and_a_lift_left_alone() {
        let path = path();
        // q = 0.1 + 0.02 s at the middles 0.5, 2, 3.5, 5, 6.5, (8), 9.5, 11
        let density = |s: f64| 0.1 + 0.02 * s;
        let want = [0.5, 2.0, 3.5, 5.0, 6.5, 8.0, 9.5, 11.0].map(density);
        let length = [1.0, 2.0, 1.0, 2.0, 1.0, 2.0, 1.0, 2.0];
        let known = [1, 4, 6];
        let mut t: Vec<f64> =
            (0..8).map(|j| if known.contains(&j) { want[j] * length[j] } else { 0.003 }).collect();
        Continuation::new(&path, |j| known.contains(&j)).apply(&mut t);
        for j in [2, 3] {
            // Rounding of densities below 1.
            assert!((t[j] / length[j] - want[j]).abs() < 1e-15, "{j}: {t:?}");
        }
        // Constant before the first and after the last decided point.
        assert!(
            (t[0] / length[0] - want[1]).abs() < 1e-15
                && (t[7] / length[7] - want[6]).abs() < 1e-15
        );
        assert_eq!(t[5], 0.003, "lifted");
    }

    #[test]
    fn gather_is_the_adjoint() {
        let path = path();
        let decided = |j: usize| [1, 4, 6].contains(&j);
        let c = Continuation::new(&path, decided);
        let u: Vec<f64> = (0..8).map(|j| if decided(j) { 0.3 + j as f64 } else { 0.0 }).collect();
        let s: Vec<f64> = (0..8).map(|j| (1.3 * f64::from(j)).sin()).collect();
        let (mut pu, mut ps) = (u.clone(), s.clone());
        c.apply(&mut pu);
        c.gather(&mut ps);
        // The lifted point is in neither.
        let product: f64 = pu.iter().zip(&s).map(|(a, b)| a * b).sum();
        let adjoint: f64 = u.iter().zip(&ps).map(|(a, b)| a * b).sum();
        // Rounding of a sum of eight products.
        assert!((product - adjoint).abs() < 1e-14, "{product} {adjoint}");
    }

    #[test]
    fn bounds_hold_and_nothing_decided_changes_nothing() {
        let path = path();
        let mut t = vec![0.5; 8];
        Continuation::new(&path, |_| false).apply(&mut t);
        assert_eq!(t, vec![0.5; 8]);
        let (lo, hi) = (vec![0.1; 8], vec![0.4; 8]);
        let mut t = vec![0.1, 0.3, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1];
        Continuation::new(&path, |j| j == 1).apply_within(&mut t, &lo, &hi);
        assert!((0..8).all(|j| (lo[j]..=hi[j]).contains(&t[j])), "{t:?}");
        // 0.15 s/mm on 1 mm and on 2 mm.
        assert!((t[0] - 0.15).abs() < 1e-15 && (t[3] - 0.3).abs() < 1e-15, "{t:?}");
    }
}
