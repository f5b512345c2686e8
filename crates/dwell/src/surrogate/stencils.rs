//! Symmetric matrices of the nodes of a lattice that couple only near ones: as they are made, an order of magnitude
//! smaller than the skyline that their factor fills.

use std::ops::Range;

use rayon::prelude::*;

/// Nodes of a lattice, numbered along the shorter side first.
#[cfg_attr(test, derive(Debug, PartialEq))]
pub struct Stencils {
    /// Nodes along the shorter side.
    shorter: usize,
    /// Most nodes from one to another that is coupled with it, along the longer side and along the shorter one.
    reach: [usize; 2],
    /// For every row those that are coupled with it and do not come after it: by the distance along the longer side, then
    /// along the shorter one.
    values: Vec<f64>,
}

impl Stencils {
    /// Zero, for so many nodes.
    pub fn zeros(nodes: usize, shorter: usize, reach: [usize; 2]) -> Self {
        Self { shorter, reach, values: vec![0.0; nodes * Self::len(reach)] }
    }

    /// Elements of a row.
    fn len(reach: [usize; 2]) -> usize {
        (reach[0] + 1) * (2 * reach[1] + 1)
    }

    /// Index in a row at s along the shorter side of the node at m there, so many before it along the longer side.
    fn at(reach: [usize; 2], before: usize, s: usize, m: usize) -> usize {
        before * (2 * reach[1] + 1) + m + reach[1] - s
    }

    /// The nodes that may be coupled with row i and do not come after it, and their indices in the row.
    fn coupled(
        i: usize,
        shorter: usize,
        reach: [usize; 2],
    ) -> impl Iterator<Item = (usize, usize)> {
        let (l, s) = (i / shorter, i % shorter);
        (0..=reach[0].min(l)).flat_map(move |before| {
            let last = if before == 0 { s } else { (s + reach[1]).min(shorter - 1) };
            (s.saturating_sub(reach[1])..=last)
                .map(move |m| ((l - before) * shorter + m, Self::at(reach, before, s, m)))
        })
    }

    /// Writes every element (i, k), k <= i, of near nodes with i in these rows.
    pub fn fill(&mut self, rows: Range<usize>, write: impl Fn(usize, usize, &mut f64) + Sync) {
        let (shorter, reach, len) = (self.shorter, self.reach, Self::len(self.reach));
        let values = &mut self.values[rows.start * len..rows.end * len];
        values.par_chunks_mut(len).zip(rows).for_each(|(row, i)| {
            Self::coupled(i, shorter, reach).for_each(|(k, at)| write(i, k, &mut row[at]));
        });
    }

    /// The rows in as many parts as leaves the rows coupled with one in it and in the part before.
    pub fn parts(&self) -> impl Iterator<Item = Range<usize>> + use<> {
        let (rows, part) = (self.rows(), self.reach[0].max(1) * self.shorter);
        (0..rows).step_by(part).map(move |from| from..(from + part).min(rows))
    }

    fn rows(&self) -> usize {
        self.values.len() / Self::len(self.reach)
    }

    /// Which rows are coupled with one of these, or one of these themselves.
    pub fn coupled_with(&self, these: &[bool]) -> Vec<bool> {
        let mut found = these.to_vec();
        for i in 0..self.rows() {
            for (k, _) in Self::coupled(i, self.shorter, self.reach) {
                found[i] |= these[k];
                found[k] |= these[i];
            }
        }
        found
    }

    /// Adds to the element of two nodes, of which the second one does not come after the first: where they are along the
    /// longer and the shorter side.
    #[inline]
    pub fn add(&mut self, [l, s]: [usize; 2], [k, m]: [usize; 2], value: f64) {
        let row = (l * self.shorter + s) * Self::len(self.reach);
        self.values[row + Self::at(self.reach, l - k, s, m)] += value;
    }

    /// Adds another of the same nodes and reach.
    pub fn add_all(&mut self, other: &Self) {
        self.values.iter_mut().zip(&other.values).for_each(|(v, other)| *v += other);
    }

    /// Adds row i to one that begins with column `first` and ends with the diagonal; what comes before must be zero.
    pub fn add_row(&self, i: usize, first: usize, to: &mut [f64]) {
        let len = Self::len(self.reach);
        let row = &self.values[i * len..(i + 1) * len];
        for (k, at) in Self::coupled(i, self.shorter, self.reach) {
            if row[at] != 0.0 {
                to[k - first] += row[at];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_those_of_the_full_matrix() {
        // 7 x 4 nodes, coupled up to 2 along the longer side and 1 along the shorter one.
        let (nodes, shorter, reach) = (28, 4, [2, 1]);
        let value = |i: usize, k: usize| (1 + i * nodes + k) as f64;
        let is_near = |i: usize, k: usize| {
            i / shorter - k / shorter <= reach[0] && (i % shorter).abs_diff(k % shorter) <= reach[1]
        };
        let mut all = Stencils::zeros(nodes, shorter, reach);
        // By parts of two lines, of which the last is half as long.
        assert_eq!(all.parts().collect::<Vec<_>>(), [0..8, 8..16, 16..24, 24..28]);
        let parts = all.parts();
        parts.for_each(|rows| all.fill(rows, |i, k, v| *v = value(i, k)));
        let mut one = Stencils::zeros(nodes, shorter, reach);
        one.add([2, 1], [1, 0], 0.25);
        one.add([2, 1], [1, 2], 0.5);
        all.add_all(&one);
        for i in 0..nodes {
            let mut row = vec![0.0; i + 1];
            all.add_row(i, 0, &mut row);
            for (k, found) in row.into_iter().enumerate() {
                let more = if (i, k) == (9, 4) {
                    0.25
                } else if (i, k) == (9, 6) {
                    0.5
                } else {
                    0.0
                };
                let expected = if is_near(i, k) { value(i, k) + more } else { 0.0 };
                assert_eq!(found, expected, "({i}, {k})");
            }
        }
        let these: Vec<bool> = (0..nodes).map(|i| i == 9).collect();
        let coupled = all.coupled_with(&these);
        let expected = |i: usize| is_near(i.max(9), i.min(9));
        assert!((0..nodes).all(|i| coupled[i] == expected(i)), "{coupled:?}");
    }
}
