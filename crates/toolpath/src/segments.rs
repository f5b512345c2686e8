//! Intersection test of two segments without rounding.
//!
//! Two segments whose bounding boxes overlap have a point in common when neither lies strictly on one
//! side of the line through the other. A side is the sign of the determinant `(b - a) x (c - a)`, which
//! the crate `robust` finds exactly (J. R. Shewchuk, Discrete Comput. Geom. 18 (1997) 305).

use robust::{Coord, orient2d};

/// Returns true if the segments `a` and `b`, each (end, [x, y]), have a point in common; touching counts.
pub(crate) fn meet(a: &[[f64; 2]; 2], b: &[[f64; 2]; 2]) -> bool {
    boxes_overlap(a, b) && side(a, b[0]) * side(a, b[1]) <= 0 && side(b, a[0]) * side(b, a[1]) <= 0
}

fn boxes_overlap(a: &[[f64; 2]; 2], b: &[[f64; 2]; 2]) -> bool {
    (0..2).all(|c| {
        a[0][c].max(a[1][c]) >= b[0][c].min(b[1][c]) && b[0][c].max(b[1][c]) >= a[0][c].min(a[1][c])
    })
}

/// Returns 1 if `p` is on the left of the line through `a`, -1 on its right, 0 on it.
fn side(a: &[[f64; 2]; 2], p: [f64; 2]) -> i32 {
    let [a, b, p] = [a[0], a[1], p].map(|[x, y]| Coord { x, y });
    match orient2d(a, b, p) {
        d if d > 0.0 => 1,
        d if d < 0.0 => -1,
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_side_of_a_line_is_decided_below_rounding() {
        // Points next to the diagonal of a square: the naive cross product is 0 or has the wrong
        // sign for most of them (L. Kettner et al., Comput. Geom. 40 (2008) 61).
        let ulp = f64::EPSILON / 4.0;
        for (i, j) in (0..40).flat_map(|i| (0..40).map(move |j| (i, j))) {
            let c = [0.5 + f64::from(i) * ulp, 0.5 + f64::from(j) * ulp];
            // x and y are multiples of 2^-54 above 1/2 where rounding keeps them so.
            let expected = (c[1] - c[0]).partial_cmp(&0.0).unwrap() as i32;
            assert_eq!(side(&[[12.0, 12.0], [24.0, 24.0]], c), expected, "{i} {j}");
            assert_eq!(side(&[[24.0, 24.0], [12.0, 12.0]], c), -expected, "{i} {j}");
            assert_eq!(side(&[c, [12.0, 12.0]], [24.0, 24.0]), expected, "{i} {j}");
        }
    }
}
