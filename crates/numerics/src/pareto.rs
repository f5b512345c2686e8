//! Pareto front of points with two quantities, both of which should be small.
//!
//! A point is on the front if no other point is at most as large in both quantities and smaller in
//! one.

/// Returns the indices in `points` of the points on the Pareto front, by ascending first quantity. Of equal points,
/// only the first is on it. Points with NaN or with an infinite second quantity are not on it.
pub fn front(points: &[[f64; 2]]) -> Vec<usize> {
    let mut order: Vec<usize> =
        (0..points.len()).filter(|&i| !points[i].iter().any(|x| x.is_nan())).collect();
    order.sort_by(|&a, &b| {
        let ([ax, ay], [bx, by]) = (points[a], points[b]);
        ax.total_cmp(&bx).then(ay.total_cmp(&by)).then(a.cmp(&b))
    });
    let mut least = f64::INFINITY;
    order.retain(|&i| {
        let is_better = points[i][1] < least;
        least = least.min(points[i][1]);
        is_better
    });
    order
}

/// Returns the area of the rectangles that points span up to a corner, in the logarithms of both quantities:
///
/// ```text
/// A = sum_i ln(x_(i+1) / x_i) ln(Y / y_i)        over the front x_1 < x_2 < ..., with x_(n+1) = X
/// ```
///
/// for the corner (X, Y). Points that are not below the corner in both quantities, or not above 0, do not count. The
/// area grows with every new point on the front, and does not depend on the units.
pub fn dominated_area(points: &[[f64; 2]], corner: [f64; 2]) -> f64 {
    let within: Vec<[f64; 2]> =
        points.iter().copied().filter(|p| (0..2).all(|k| p[k] > 0.0 && p[k] < corner[k])).collect();
    let front = front(&within);
    let next = front.iter().skip(1).map(|&i| within[i][0]).chain([corner[0]]);
    front
        .iter()
        .zip(next)
        .map(|(&i, x)| (x / within[i][0]).ln() * (corner[1] / within[i][1]).ln())
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the front by its definition: compares every point with every other one.
    fn by_definition(points: &[[f64; 2]]) -> Vec<usize> {
        let dominates = |a: [f64; 2], b: [f64; 2]| a[0] <= b[0] && a[1] <= b[1] && a != b;
        let mut front: Vec<usize> = (0..points.len())
            .filter(|&i| !points.iter().any(|&p| dominates(p, points[i])))
            .filter(|&i| !points[..i].contains(&points[i]))
            .collect();
        front.sort_by(|&a, &b| points[a][0].total_cmp(&points[b][0]));
        front
    }

    #[test]
    fn the_front_is_that_of_the_definition() {
        // Integers: many equal coordinates.
        let mut state = 1u64;
        let mut next = |n: u64| {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            ((state >> 33) % n) as f64
        };
        for count in 0..60 {
            let points: Vec<[f64; 2]> = (0..count).map(|_| [next(12), next(12)]).collect();
            assert_eq!(front(&points), by_definition(&points), "{points:?}");
        }
        assert_eq!(front(&[[f64::NAN, 0.0], [1.0, 1.0]]), [1]);
    }

    #[test]
    fn the_area_is_that_of_rectangles_in_the_logarithms() {
        let e = f64::exp;
        // The area of one point is a rectangle of 2 by 3. The second point adds 1 by 1.
        let corner = [e(2.0), e(3.0)];
        // Below: rounding of exponentials and logarithms of numbers up to 3.
        assert!((dominated_area(&[[1.0, 1.0]], corner) - 6.0).abs() < 1e-12);
        let two = [[e(1.0), e(1.0)], [1.0, e(2.0)]];
        assert!((dominated_area(&two, corner) - (1.0 + 2.0)).abs() < 1e-12);
        // A point that is dominated, or outside of the corner, adds nothing.
        let more = [&two[..], &[[e(1.5), e(1.5)], [e(9.0), 1.0]]].concat();
        assert_eq!(dominated_area(&more, corner), dominated_area(&two, corner));
    }
}
