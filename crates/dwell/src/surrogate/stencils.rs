//! Symmetric matrices with a row for every node of a lattice, whose elements are zero except for nodes near each other
//! (coupled nodes). Before they are factorised they take an order of magnitude less memory than the skyline that their
//! factor fills. A *line* is a line of nodes of the lattice.

use std::ops::Range;

use planish_numerics::parallel;

/// Matrix of the nodes of a lattice, which are numbered line by line; it has a row for every node.
#[cfg_attr(test, derive(Debug, PartialEq))]
pub struct Stencils {
    /// Number of nodes of a line.
    per_line: usize,
    /// Largest distance of two coupled nodes, in nodes: [across the lines, along them].
    reach: [usize; 2],
    /// Elements of every row at the nodes that are coupled with its node and do not come after it: ordered by the
    /// distance across the lines, then along them.
    values: Vec<f64>,
}

impl Stencils {
    /// Makes the zero matrix for `nodes` nodes in lines of `per_line` nodes, with room for couplings up to `reach`
    /// nodes [across, along] the lines.
    pub fn zeros(nodes: usize, per_line: usize, reach: [usize; 2]) -> Self {
        Self { per_line, reach, values: vec![0.0; nodes * Self::len(reach)] }
    }

    /// Returns the number of stored elements of a row.
    fn len(reach: [usize; 2]) -> usize {
        (reach[0] + 1) * (2 * reach[1] + 1)
    }

    /// Returns the index of an element in the stored values of its row. The node of the row has the index s in its
    /// line; the other node has the index m in its line, which is `before` lines earlier.
    fn index(reach: [usize; 2], before: usize, s: usize, m: usize) -> usize {
        before * (2 * reach[1] + 1) + m + reach[1] - s
    }

    /// Returns the nodes that may be coupled with a node of these rows, all of one line, and do not come after the last
    /// of them. A node is (number of lines before this line, index in its line).
    fn near(
        rows: &Range<usize>,
        per_line: usize,
        reach: [usize; 2],
    ) -> impl Iterator<Item = (usize, usize)> + use<> {
        let l = rows.start / per_line;
        let first = rows.start % per_line;
        let last = (rows.end - 1) % per_line;
        (0..=reach[0].min(l)).flat_map(move |before| {
            let end = if before == 0 { last } else { (last + reach[1]).min(per_line - 1) };
            (first.saturating_sub(reach[1])..=end).map(move |m| (before, m))
        })
    }

    /// Returns the nodes that may be coupled with node i and do not come after it, i included, and the indices of their
    /// elements in row i.
    fn coupled(
        i: usize,
        per_line: usize,
        reach: [usize; 2],
    ) -> impl Iterator<Item = (usize, usize)> {
        let l = i / per_line;
        let s = i % per_line;
        Self::near(&(i..i + 1), per_line, reach)
            .map(move |(before, m)| ((l - before) * per_line + m, Self::index(reach, before, s, m)))
    }

    /// Calls `write`, in parallel, for parts of the rows `rows`, which must be those of whole lines of nodes. A part
    /// has up to `most` rows of one line.
    pub fn fill(&mut self, rows: Range<usize>, most: usize, write: impl Fn(Near<'_>) + Sync) {
        let Self { per_line, reach, .. } = *self;
        let len = Self::len(reach);
        let values = &mut self.values[rows.start * len..rows.end * len];
        let lines = values.chunks_mut(per_line * len).enumerate();
        let pieces = lines.flat_map(|(line, values)| {
            let starts = (rows.start + line * per_line..).step_by(most);
            starts.zip(values.chunks_mut(most * len))
        });
        parallel::consume(pieces, &|_, (start, values)| {
            write(Near { rows: start..start + values.len() / len, per_line, reach, values });
        });
    }

    /// Returns the rows divided into ranges so long that the nodes that are coupled with a row and come before it are
    /// in its range and in the range before.
    pub fn parts(&self) -> impl Iterator<Item = Range<usize>> + use<> {
        let rows = self.rows();
        let part = self.reach[0].max(1) * self.per_line;
        (0..rows).step_by(part).map(move |from| from..(from + part).min(rows))
    }

    /// Returns the number of rows: one for every node.
    fn rows(&self) -> usize {
        self.values.len() / Self::len(self.reach)
    }

    /// Returns the mask of the nodes that are in `these` or are coupled with one of them.
    pub fn coupled_with(&self, these: &[bool]) -> Vec<bool> {
        let mut coupled = these.to_vec();
        for i in 0..self.rows() {
            for (k, _) in Self::coupled(i, self.per_line, self.reach) {
                coupled[i] |= these[k];
                coupled[k] |= these[i];
            }
        }
        coupled
    }

    /// Adds `value` to the element of two nodes, each given as [line, index in the line]. The second node must not come
    /// after the first and must be within the reach of the matrix.
    #[inline]
    pub fn add(&mut self, [l, s]: [usize; 2], [k, m]: [usize; 2], value: f64) {
        let row = (l * self.per_line + s) * Self::len(self.reach);
        self.values[row + Self::index(self.reach, l - k, s, m)] += value;
    }

    /// Adds another matrix of the same nodes and reach.
    pub fn add_all(&mut self, other: &Self) {
        self.values.iter_mut().zip(&other.values).for_each(|(v, other)| *v += other);
    }

    /// Adds row i of the matrix, up to the diagonal, to `to`, which begins with the element of column `first`. Elements
    /// of the row before column `first` must be zero.
    pub fn add_row(&self, i: usize, first: usize, to: &mut [f64]) {
        let len = Self::len(self.reach);
        let row = &self.values[i * len..(i + 1) * len];
        for (k, index) in Self::coupled(i, self.per_line, self.reach) {
            if row[index] != 0.0 {
                to[k - first] += row[index];
            }
        }
    }
}

/// Some neighbouring rows of [`Stencils`], all of one line of nodes, to be written.
pub struct Near<'a> {
    rows: Range<usize>,
    per_line: usize,
    reach: [usize; 2],
    values: &'a mut [f64],
}

impl Near<'_> {
    /// Returns the range of the rows in this part.
    pub fn rows(&self) -> Range<usize> {
        self.rows.clone()
    }

    /// Returns the nodes that may be coupled with a node of these rows and do not come after the last of them.
    pub fn coupled(&self) -> impl Iterator<Item = usize> + use<> {
        let per_line = self.per_line;
        let l = self.rows.start / per_line;
        let near = Stencils::near(&self.rows, per_line, self.reach);
        near.map(move |(before, m)| (l - before) * per_line + m)
    }

    /// Returns the element of row i, which must be in this part, and node k, to be written. `None` if k comes after i,
    /// or is farther from it than coupled nodes are.
    pub fn element(&mut self, i: usize, k: usize) -> Option<&mut f64> {
        let [(l, s), (n, m)] = [i, k].map(|node| (node / self.per_line, node % self.per_line));
        let is_near = k <= i && l - n <= self.reach[0] && s.abs_diff(m) <= self.reach[1];
        if !is_near {
            return None;
        }
        let row = (i - self.rows.start) * Stencils::len(self.reach);
        Some(&mut self.values[row + Stencils::index(self.reach, l - n, s, m)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_those_of_the_full_matrix() {
        // 7 x 4 nodes, coupled up to 2 across the lines and 1 along them.
        let (nodes, per_line, reach) = (28, 4, [2, 1]);
        let value = |i: usize, k: usize| (1 + i * nodes + k) as f64;
        let is_near = |i: usize, k: usize| {
            i / per_line - k / per_line <= reach[0]
                && (i % per_line).abs_diff(k % per_line) <= reach[1]
        };
        let mut all = Stencils::zeros(nodes, per_line, reach);
        // By parts of two lines, of which the last is half as long.
        assert_eq!(all.parts().collect::<Vec<_>>(), [0..8, 8..16, 16..24, 24..28]);
        let parts = all.parts();
        parts.for_each(|rows| {
            all.fill(rows, 3, |mut near| {
                assert!((1..=3).contains(&near.rows().len()));
                for k in near.coupled() {
                    for i in near.rows() {
                        if let Some(v) = near.element(i, k) {
                            *v = value(i, k);
                        }
                    }
                }
            });
        });
        let mut one = Stencils::zeros(nodes, per_line, reach);
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
