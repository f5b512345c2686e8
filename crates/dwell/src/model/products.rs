//! Products of columns of B with each other: the elements of `B' B`.
//!
//! The product of two columns is zero unless their patches overlap. With the columns sorted along one axis of the map,
//! every row of the matrix begins near its diagonal. A Cholesky factor has elements only there.

use std::ops::Range;

use planish_numerics::linear::{
    interleaved::{self, PitchedRows},
    skyline::Skyline,
};

use super::columns::Patch;

/// Largest number of columns in a [`Bundle`] (8): the number of products that the processor computes at once.
pub const MOST_BUNDLED: usize = interleaved::EIGHT;

/// A few columns of B side by side, on the rectangle of pixels that contains all of them. Their products with another
/// column read that column once for all.
#[derive(Debug)]
pub struct Bundle {
    origin: (usize, usize),
    shape: (usize, usize),
    /// Removal rate of every column, nm/s, pixel by pixel ([`MOST_BUNDLED`] numbers of each); zero where a column does
    /// not reach.
    rate_nm_per_s: Vec<f64>,
}

impl Bundle {
    /// Bundles up to [`MOST_BUNDLED`] columns. They should be near each other, because the bundle covers the rectangle
    /// around all. Panics if there are more columns.
    pub fn new<'a>(patches: impl Iterator<Item = &'a Patch> + Clone) -> Self {
        let [rows, columns] = [0, 1].map(|axis| {
            let ranges = patches.clone().filter(|p| !p.rate_nm_per_s.is_empty());
            let ranges = ranges.map(|p| p.range(axis));
            ranges.reduce(|a, b| a.start.min(b.start)..a.end.max(b.end)).unwrap_or_default()
        });
        let mut rate_nm_per_s = vec![0.0; rows.len() * columns.len() * MOST_BUNDLED];
        for (lane, patch) in patches.enumerate() {
            assert!(lane < MOST_BUNDLED, "more patches than a bundle holds");
            for ((r, c), rate) in patch.rate_nm_per_s.indexed_iter() {
                let r = r + patch.origin.0 - rows.start;
                let c = c + patch.origin.1 - columns.start;
                rate_nm_per_s[(r * columns.len() + c) * MOST_BUNDLED + lane] = *rate;
            }
        }
        let origin = (rows.start, columns.start);
        Self { origin, shape: (rows.len(), columns.len()), rate_nm_per_s }
    }

    /// Returns the product of every column of the bundle with another column, summed over their common pixels.
    /// Elements beyond the last column of the bundle are zero.
    pub fn dots(&self, other: &Patch) -> [f64; MOST_BUNDLED] {
        let mut dots = [0.0; MOST_BUNDLED];
        let rows = overlap(self.origin.0, self.shape.0, other.range(0));
        let columns = overlap(self.origin.1, self.shape.1, other.range(1));
        if !rows.is_empty() && !columns.is_empty() {
            let nx = self.shape.1;
            let mx = other.rate_nm_per_s.ncols();
            let [own, other_first] = [(self.origin, nx), (other.origin, mx)]
                .map(|(origin, pitch)| (rows.start - origin.0) * pitch + columns.start - origin.1);
            let a = PitchedRows { numbers: &self.rate_nm_per_s[own * MOST_BUNDLED..], pitch: nx };
            let b = PitchedRows { numbers: &other.all()[other_first..], pitch: mx };
            interleaved::add_products(a, b, (rows.len(), columns.len()), &mut dots);
        }
        dots
    }
}

/// Returns the common part of the range of `len` elements from `start` on and another range; it may be empty.
fn overlap(start: usize, len: usize, other: Range<usize>) -> Range<usize> {
    start.max(other.start)..(start + len).min(other.end)
}

/// Columns of B in an order in which the matrix of their products has a small skyline (few elements from the first
/// stored one of each row to the diagonal).
pub struct Order {
    /// Index of the column of B for every row of the matrix.
    pub order: Vec<usize>,
    /// First stored column of every row of the matrix.
    pub first: Vec<usize>,
    /// Number of stored elements of the matrix, up to the diagonal, over all rows.
    pub elements: usize,
}

impl Order {
    /// Orders some `columns` (indices) along that axis of the map for which the skyline is smaller. `position(axis, j)`
    /// is the coordinate of column j along x (0) or y (1), in any unit. The skyline also has room for the elements of
    /// `pairs` of columns, if both are in `columns`.
    pub fn new(
        columns: &[usize],
        patches: &[Patch],
        position: impl Fn(usize, usize) -> f64,
        pairs: &[(usize, usize)],
    ) -> Self {
        let [x, y] = [0, 1].map(|axis| Self::along(axis, columns, patches, &position, pairs));
        if x.elements <= y.elements { x } else { y }
    }

    /// Orders the columns along x (`axis` 0) or y (1).
    fn along(
        axis: usize,
        columns: &[usize],
        patches: &[Patch],
        position: impl Fn(usize, usize) -> f64,
        pairs: &[(usize, usize)],
    ) -> Self {
        let mut order = columns.to_vec();
        order.sort_by(|a, b| position(axis, *a).total_cmp(&position(axis, *b)).then(a.cmp(b)));
        // Columns up to the first one that reaches so far cannot meet it.
        let range = |j: usize| patches[j].range(1 - axis);
        let mut so_far: Vec<usize> = Vec::with_capacity(order.len());
        for j in &order {
            let before = so_far.last().copied().unwrap_or(0);
            so_far.push(range(*j).end.max(before));
        }
        let mut first: Vec<usize> = Vec::with_capacity(order.len());
        for (i, j) in order.iter().enumerate() {
            let from = so_far[..i].partition_point(|end| *end <= range(*j).start);
            let mut near = from..i;
            first.push(near.find(|l| patches[order[*l]].overlaps(&patches[*j])).unwrap_or(i));
        }
        let row_of = rows(&order, patches.len());
        for (a, b) in pairs {
            if let (Some(a), Some(b)) = (row_of[*a], row_of[*b]) {
                first[a.max(b)] = first[a.max(b)].min(a.min(b));
            }
        }
        let elements = first.iter().enumerate().map(|(i, f)| i + 1 - f).sum();
        Self { order, first, elements }
    }

    /// Estimates the number of multiplications of a Cholesky factorisation: half the square of the length of each row.
    pub fn work(&self) -> f64 {
        let lengths = self.first.iter().enumerate().map(|(i, first)| (i + 1 - first) as f64);
        lengths.map(|length| 0.5 * length * length).sum()
    }

    /// Returns the matrix of the products of these columns of B. If `known(i, l)` returns a value, this is the element
    /// of row i and column l of the matrix, which is then not computed.
    pub fn products(
        &self,
        patches: &[Patch],
        known: impl Fn(usize, usize) -> Option<f64> + Sync,
    ) -> Skyline {
        let Self { order, first, .. } = self;
        let mut products = Skyline::zeros(first.clone());
        products.fill_together(MOST_BUNDLED, |rows, elements| {
            let bundled = rows.clone().map(|i| &patches[order[i]]);
            let mut bundle = None;
            for l in first[rows.clone()].iter().copied().min().unwrap_or(rows.end)..rows.end {
                let mut dots = None;
                for (k, i) in rows.clone().enumerate().filter(|(_, i)| first[*i] <= l && l <= *i) {
                    elements[k][l - first[i]] = known(i, l).unwrap_or_else(|| {
                        let bundle = bundle.get_or_insert_with(|| Bundle::new(bundled.clone()));
                        dots.get_or_insert_with(|| bundle.dots(&patches[order[l]]))[k]
                    });
                }
            }
        });
        products
    }
}

/// Returns, for each of all `columns` columns of B, the row that `order` gives it; `None` if it is not in `order`.
pub fn rows(order: &[usize], columns: usize) -> Vec<Option<usize>> {
    let mut rows = vec![None; columns];
    order.iter().enumerate().for_each(|(i, j)| rows[*j] = Some(i));
    rows
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;

    /// Returns a patch whose numbers differ from those of every other patch.
    fn patch(origin: (usize, usize), shape: (usize, usize)) -> Patch {
        let of = |(r, c)| {
            let (r, c) = ((r + origin.0) as f64, (c + origin.1) as f64);
            (1.3 * r).sin() + (0.7 * c + r).cos() + shape.1 as f64
        };
        Patch { origin, rate_nm_per_s: Array2::from_shape_fn(shape, of) }
    }

    /// Returns the product of two patches, computed pixel by pixel.
    fn product(a: &Patch, b: &Patch) -> f64 {
        let at = |p: &Patch, (r, c): (usize, usize)| {
            let inside = p.range(0).contains(&r) && p.range(1).contains(&c);
            if inside { p.rate_nm_per_s[[r - p.origin.0, c - p.origin.1]] } else { 0.0 }
        };
        let pixels = a.range(0).flat_map(|r| a.range(1).map(move |c| (r, c)));
        pixels.map(|pixel| at(a, pixel) * at(b, pixel)).sum()
    }

    #[test]
    fn a_bundle_has_the_products_of_its_patches() {
        // One above the other, empty, and on its own far from them.
        let patches = [
            patch((0, 0), (7, 9)),
            patch((3, 2), (8, 5)),
            patch((0, 0), (0, 0)),
            patch((5, 8), (4, 4)),
            patch((30, 31), (3, 2)),
        ];
        let bundle = Bundle::new(patches.iter());
        for other in patches.iter().chain([&patch((2, 1), (9, 11)), &patch((50, 50), (3, 3))]) {
            let dots = bundle.dots(other);
            for (patch, dot) in patches.iter().zip(dots) {
                // Some 60 products of at most 200 in another order.
                assert!((dot - product(patch, other)).abs() < 1e-11);
            }
            assert_eq!(dots[patches.len()..], [0.0; 3]);
        }
        assert!(bundle.dots(&patches[1])[0] > 1.0);
        assert_eq!(Bundle::new(patches[2..3].iter()).dots(&patches[0]), [0.0; MOST_BUNDLED]);
    }

    /// Returns patches of different sizes at scattered positions, so that some reach much further than their
    /// neighbours.
    fn scattered() -> Vec<Patch> {
        let at = |k: usize| {
            let length = if k.is_multiple_of(6) { 30 } else { 9 };
            patch((8 * (k % 5), 5 * (k * 7 % 25)), (11, length))
        };
        (0..25).map(at).collect()
    }

    fn centre(patch: &Patch, axis: usize) -> f64 {
        let range = patch.range(1 - axis);
        (range.start + range.end) as f64
    }

    #[test]
    fn a_row_begins_where_the_first_column_meets_it() {
        let patches = scattered();
        let all: Vec<usize> = (0..patches.len()).collect();
        for axis in [0, 1] {
            let at = |axis: usize, j: usize| centre(&patches[j], axis);
            let order = Order::along(axis, &all, &patches, at, &[]);
            for (i, first) in order.first.iter().enumerate() {
                let meets = |l: &usize| patches[order.order[*l]].overlaps(&patches[order.order[i]]);
                assert_eq!(*first, (0..i).find(meets).unwrap_or(i), "{i} along {axis}");
            }
            assert!(order.first.iter().enumerate().any(|(i, first)| first + 3 < i));
            assert!(order.first.iter().any(|first| *first > 3));
        }
    }

    #[test]
    fn the_matrix_has_the_products_of_its_columns_and_what_is_known() {
        let patches = scattered();
        let columns: Vec<usize> = (0..patches.len()).filter(|j| *j != 3).collect();
        let at = |axis: usize, j: usize| centre(&patches[j], axis);
        let order = Order::new(&columns, &patches, at, &[(0, 24), (3, 4)]);
        let given = |i: usize, l: usize| ((i + l) % 7 == 2).then_some(-1.0);
        let matrix = order.products(&patches, given);
        assert!(matrix.elements() >= order.elements);
        let (mut products, mut taken) = (0, 0);
        for i in 0..columns.len() {
            for l in 0..=i {
                let (a, b) = (&patches[order.order[i]], &patches[order.order[l]]);
                let expected = product(a, b);
                let expected = match given(i, l) {
                    Some(v) if order.first[i] <= l => v,
                    _ => expected,
                };
                products += usize::from(l < i && expected > 0.0);
                taken += usize::from(expected == -1.0);
                // Some 300 products of at most 1000 in another order.
                assert!((matrix.element(i, l) - expected).abs() < 1e-9, "{i} {l}");
            }
        }
        assert!(products > 5 && taken > 5, "{products} {taken}");
        // The pair has room; that of the column that is left out does not exist.
        let row = |j: usize| order.order.iter().position(|k| *k == j).unwrap();
        let (a, b) = (row(0), row(24));
        assert!(order.first[a.max(b)] <= a.min(b));
    }
}
