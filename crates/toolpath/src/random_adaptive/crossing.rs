//! Pairs of crossing steps of closed paths.
//!
//! Whether two steps meet is decided without rounding ([`crate::segments`]), so no crossing is missed.

use super::{Point, distance};
use crate::segments::meet;

/// Returns the indices (path, step) of both steps of every pair of steps that meet. Each of `loops` is a closed path,
/// and neighbouring steps of a path do not count.
pub(super) fn crossings(loops: &[Vec<Point>]) -> Vec<[(usize, usize); 2]> {
    let mut segments: Vec<(Point, Point, usize, usize)> = Vec::new();
    for (l, nodes) in loops.iter().enumerate() {
        let ends = nodes.iter().zip(nodes.iter().cycle().skip(1));
        segments.extend(ends.enumerate().map(|(i, (a, b))| (*a, *b, l, i)));
    }
    let mean = segments.iter().map(|s| distance(s.0, s.1)).sum::<f64>() / segments.len() as f64;
    let side = 2.0 * mean;
    let mut touched: Vec<(i64, i64, u32)> = Vec::new();
    for (k, (a, b, ..)) in segments.iter().enumerate() {
        let [p, q] = [a, b].map(|p| p.map(|v| (v / side).floor() as i64));
        for y in p[1].min(q[1])..=p[1].max(q[1]) {
            touched.extend((p[0].min(q[0])..=p[0].max(q[0])).map(|x| (y, x, k as u32)));
        }
    }
    touched.sort_unstable();
    let mut pairs = Vec::new();
    for together in touched.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        for (i, (.., j)) in together.iter().enumerate() {
            for (.., k) in &together[i + 1..] {
                let (s, t) = (&segments[*j as usize], &segments[*k as usize]);
                let n = loops[s.2].len();
                let apart = t.3 - s.3.min(t.3);
                let neighbours = s.2 == t.2 && (apart <= 1 || apart == n - 1);
                if !neighbours && meet(&[s.0, s.1], &[t.0, t.1]) {
                    pairs.push([(s.2, s.3), (t.2, t.3)]);
                }
            }
        }
    }
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crossings_touches_and_misses() {
        let (o, x) = ([0.0, 0.0], [2.0, 0.0]);
        let meet = |c, d| meet(&[o, x], &[c, d]);
        assert!(meet([1.0, -1.0], [1.0, 1.0]));
        assert!(meet([1.0, 0.0], [1.0, 1.0]));
        assert!(meet([1.0, 0.0], [3.0, 0.0]));
        assert!(!meet([3.0, 0.0], [4.0, 0.0]));
        assert!(!meet([1.0, 1e-12], [1.0, 1.0]));
        assert!(!meet([3.0, -1.0], [3.0, 1.0]));
    }

    #[test]
    fn a_figure_of_eight_crosses_itself_once() {
        let eight = vec![[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]];
        assert_eq!(crossings(&[eight]), [[(0, 0), (0, 2)]]);
        let (square, apart) = (
            vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]],
            vec![[0.2, 0.2], [0.8, 0.2], [0.5, 0.5]],
        );
        assert!(crossings(&[square.clone(), apart]).is_empty());
        let through = vec![[0.5, 0.5], [1.5, 0.5], [1.5, 0.6]];
        assert_eq!(crossings(&[square, through]).len(), 2);
    }
}
