//! Dwell times spread on the lines of the lattice, and the spill: the removal that Keys' interpolation adds beyond the
//! two edges of the TIF across these lines. It is (2) of [`crate::model::fft_operator`], with its adjoint. The lines
//! are rows of the map or, with the axes swapped, columns.

use std::ops::{Range, RangeInclusive};

use ndarray::{Array2, ArrayView2, Axis as NdAxis};
use planish_numerics::{
    fft::{Complex64, add_conjugate_products, add_products, line},
    keys, parallel,
    vectors::vectorised,
};

use super::lattice::{Lattice, Placed};

/// Places of the tool in the order of their cells across the lines. Pairs are [across, along] the lines.
pub struct Across {
    pub across: Lattice,
    pub along: Lattice,
    places: Vec<Placed>,
    groups: Vec<Group>,
    lines: line::Lines,
    /// Lines of samples of the TIF that spill: their indices j across, and their spectra.
    border: Vec<(isize, Vec<Complex64>)>,
}

/// Places with the same cell across the lines that spill onto the same lines.
struct Group {
    cell: isize,
    /// Offsets from the cell: lines up to the first and from the second one on receive spill.
    spills: [isize; 2],
    places: Range<usize>,
}

/// Part of a line on which a place is spread: its sources `start .. end`, and the number of the four weights that fall
/// before them, beyond the line.
struct Under {
    start: usize,
    end: usize,
    skipped: usize,
}

impl Under {
    /// Returns the sum of the values of a line on this part, each times its weight of the four.
    fn sum(&self, weights: &[f64; 4], line: &[f64]) -> f64 {
        let on = line[self.start..self.end].iter().zip(&weights[self.skipped..]);
        on.map(|(v, w)| w * v).sum()
    }

    /// Adds `seconds` times the four weights to a line on this part.
    fn add(&self, seconds: f64, weights: &[f64; 4], line: &mut [f64]) {
        let on = line[self.start..self.end].iter_mut().zip(&weights[self.skipped..]);
        on.for_each(|(v, w)| *v += w * seconds);
    }
}

/// Largest number of nodes along an axis that receive spill, and of samples along an axis that spill. The lower edge
/// has three of each. The upper edge, which may lie between two nodes, has at most four nodes and five samples. A
/// smaller number fails an assertion.
const MAX_BORDER: usize = 8;

/// A number for each of the nodes of one axis that receive spill.
type Nodes = [f64; MAX_BORDER];

/// Samples at the corners of the TIF, for the removal that spills over two edges at once.
pub struct Corners {
    /// Offsets c along the lines, from the cell, of the nodes beyond the edges.
    nodes: Vec<isize>,
    /// Samples g[j, c - e] for every spilling sample j across, every weight e = -1 ..= 2 along, and every node c.
    samples: Vec<[Nodes; 4]>,
}

/// Number of lines of the lattice that one thread takes at a time. Larger: fewer tasks for the threads. Smaller: more
/// overhead.
pub const LINES_PER_TASK: usize = 32;

impl Across {
    /// Sorts the places by their cells across, and transforms those lines of the samples [across, along] that spill.
    pub fn new(
        across: Lattice,
        along: Lattice,
        samples: ArrayView2<f64>,
        mut places: Vec<Placed>,
    ) -> Self {
        places.sort_by_key(|p| (p.cell[0], across.spills(p.offset[0])));
        let mut groups: Vec<Group> = Vec::new();
        for (i, p) in places.iter().enumerate() {
            let cell = p.cell[0] as isize;
            let spills = across.spills(p.offset[0]);
            match groups.last_mut() {
                Some(g) if g.cell == cell && g.spills == spills => g.places.end = i + 1,
                _ => groups.push(Group { cell, spills, places: i..i + 1 }),
            }
        }
        let lines = line::Lines::new(along.sources());
        let mut work = lines.workspace();
        // The lowest line from the upper edge on gets something from three samples below it.
        let upper = keys::split(across.edge).0 - 2;
        let border = (-1..=across.last)
            .filter(|j| *j <= 1 || *j >= upper)
            .map(|j| {
                let mut spectrum = vec![Complex64::default(); lines.half()];
                let g = samples.row((j + 1) as usize);
                lines.forward(
                    |line: &mut [f64]| line.iter_mut().zip(g).for_each(|(l, g)| *l = *g),
                    &mut spectrum,
                    &mut work,
                );
                (j, spectrum)
            })
            .collect();
        Self { across, along, places, groups, lines, border }
    }

    /// Returns the spectrum of line j of the samples; `None` if it does not spill.
    fn sample(&self, j: isize) -> Option<&[Complex64]> {
        self.border.iter().find(|(k, _)| *k == j).map(|(_, g)| g.as_slice())
    }

    /// Returns the groups whose cells across are in the range.
    fn within(&self, cells: Range<isize>) -> &[Group] {
        let [from, to] =
            [cells.start, cells.end].map(|cell| self.groups.partition_point(|g| g.cell < cell));
        &self.groups[from..to.max(from)]
    }

    /// Returns the dwell times t (n) spread on the sources, S t, shape (across, along), s.
    pub fn seconds(&self, t: &[f64]) -> Array2<f64> {
        let mut seconds = Array2::zeros((self.across.sources(), self.along.sources()));
        parallel::for_each_band(&mut seconds, LINES_PER_TASK, &|b, mut band| {
            // Nodes from -last on, and those that spread on one of them.
            let first = (b * LINES_PER_TASK) as isize - self.across.last;
            let count = band.nrows() as isize;
            for group in self.within(first - 2..first + count + 1) {
                let lines = (0..4).map(|i| (i, group.cell - 1 + i as isize - first));
                let lines = lines.filter(|(_, line)| (0..count).contains(line));
                for p in &self.places[group.places.clone()] {
                    let (across, along) = self.weights(p);
                    let under = self.sources_under(p);
                    let second = t[p.column as usize] * p.fraction;
                    for (i, line) in lines.clone() {
                        let seconds = second * across[i];
                        let mut line = band.row_mut(line as usize);
                        let line = line.as_slice_mut().expect("in C order");
                        under.add(seconds, &along, line);
                    }
                }
            }
        });
        seconds
    }

    /// Returns the four weights of a place across the lines, and the four along them, of the nodes -1 ..= 2 from its
    /// cell.
    #[inline(always)]
    fn weights(&self, p: &Placed) -> ([f64; 4], [f64; 4]) {
        (self.across.weights(p.offset[0]), self.along.weights(p.offset[1]))
    }

    /// Returns the sources of a line on which a place is spread.
    fn sources_under(&self, p: &Placed) -> Under {
        let first = p.cell[1] as isize - 1 + self.along.last;
        let sources = self.along.sources() as isize;
        let start = first.clamp(0, sources);
        let end = (first + 4).clamp(0, sources);
        Under { start: start as usize, end: end as usize, skipped: (start - first) as usize }
    }

    /// Adds to a line the dwell times, s, of all places of a group, each times its weight d (-1 ..= 2) across and
    /// spread with its weights along.
    fn spread(&self, group: &Group, d: isize, t: &[f64], line: &mut [f64]) {
        for p in &self.places[group.places.clone()] {
            let (across, along) = self.weights(p);
            let seconds = t[p.column as usize] * p.fraction * across[(d + 1) as usize];
            self.sources_under(p).add(seconds, &along, line);
        }
    }

    /// Returns the adjoint product `S' f` of the spreading for an array f on the sources (across, along): one number
    /// for each of `columns` columns.
    pub fn gather(&self, field: &Array2<f64>, columns: usize) -> Vec<f64> {
        let field = field.as_slice().expect("in C order");
        let height = self.across.sources() as isize;
        let width = self.along.sources();
        let values = parallel::map(self.places.len(), &|p| {
            let p = &self.places[p];
            let (across, along) = self.weights(p);
            let under = self.sources_under(p);
            let first = p.cell[0] as isize - 1 + self.across.last;
            let mut sum = 0.0;
            for (i, w) in across.iter().enumerate() {
                let r = first + i as isize;
                if r >= 0 && r < height {
                    sum += w * under.sum(&along, &field[r as usize * width..]);
                }
            }
            sum
        });
        let mut sums = vec![0.0; columns];
        for (p, v) in self.places.iter().zip(&values) {
            sums[p.column as usize] += p.fraction * v;
        }
        sums
    }

    /// Returns the offsets k, from the cell, of the lines onto which a group spills over the lower or the upper edge of
    /// the TIF.
    fn lines_beyond(&self, group: &Group, upper: bool) -> RangeInclusive<isize> {
        if upper { group.spills[1]..=self.across.last + 2 } else { -2..=group.spills[0] }
    }

    /// Returns the weights d, -1 ..= 2, by which a group spills onto the line at the offset k.
    fn weights_of(&self, k: isize, upper: bool) -> RangeInclusive<isize> {
        if upper { (k - self.across.last).max(-1)..=2 } else { -1..=(k + 1).min(2) }
    }

    /// Returns all pairs (line offset k, weight d) by which a group spills over the lower or the upper edge of the TIF.
    fn pairs(&self, group: &Group, upper: bool) -> impl Iterator<Item = (isize, isize)> {
        self.lines_beyond(group, upper)
            .flat_map(move |k| self.weights_of(k, upper).map(move |d| (k, d)))
    }

    /// Returns the range of cells from which tools may spill onto lines of the range, over the lower or the upper edge
    /// of the TIF.
    fn cells(&self, lines: &Range<isize>, upper: bool) -> Range<isize> {
        if upper {
            lines.start - self.across.last - 2..lines.end - self.across.edge.floor() as isize
        } else {
            lines.start..lines.end + 2
        }
    }

    /// Returns the spill (2) of [`super`] onto the lines of the map, shape (across, along), nm, for dwell times t (n),
    /// s. With `corners`, pixels beyond an edge across and an edge along are left out.
    pub fn spill(&self, t: &[f64], corners: Option<&Corners>) -> Array2<f64> {
        let pixels = self.along.pixels;
        let mut map = Array2::zeros((self.across.pixels, pixels));
        let half = self.lines.half();
        parallel::consume_with(
            map.axis_chunks_iter_mut(NdAxis(0), LINES_PER_TASK),
            &|| (self.lines.workspace(), vec![Complex64::default(); half]),
            &|(work, seconds), b, mut band| {
                let range =
                    (b * LINES_PER_TASK) as isize..(b * LINES_PER_TASK + band.nrows()) as isize;
                let mut sums = vec![Complex64::default(); half * band.nrows()];
                let mut used = vec![false; band.nrows()];
                for upper in [false, true] {
                    for group in self.within(self.cells(&range, upper)) {
                        for d in -1..=2 {
                            let mut known = false;
                            for (k, _) in self.pairs(group, upper).filter(|p| p.1 == d) {
                                let line = group.cell + k;
                                let Some(g) = self.sample(k - d).filter(|_| range.contains(&line))
                                else {
                                    continue;
                                };
                                if !known {
                                    known = true;
                                    self.lines.forward(
                                        |line: &mut [f64]| self.spread(group, d, t, line),
                                        seconds,
                                        work,
                                    );
                                }
                                let r = (line - range.start) as usize;
                                used[r] = true;
                                let sum = &mut sums[r * half..(r + 1) * half];
                                add_products(sum, seconds, g);
                            }
                        }
                    }
                }
                for (r, mut row) in band.outer_iter_mut().enumerate().filter(|(r, _)| used[*r]) {
                    let line = self.lines.inverse(&sums[r * half..(r + 1) * half], work);
                    let from = self.along.last as usize + 1;
                    row.iter_mut().zip(&line[from..]).for_each(|(v, l)| *v = *l);
                }
                let Some(corners) = corners else { return };
                let top = range.start as usize;
                let band = band.as_slice_mut().expect("in C order");
                vectorised(
                    #[inline(always)]
                    || {
                        for upper in [false, true] {
                            for group in self.within(self.cells(&range, upper)) {
                                for p in &self.places[group.places.clone()] {
                                    let seconds = t[p.column as usize] * p.fraction;
                                    self.corner(p, group, upper, corners, &range, |r, c, rate| {
                                        band[(r - top) * pixels + c] -= seconds * rate;
                                    });
                                }
                            }
                        }
                    },
                );
            },
        );
        map
    }

    /// Returns the samples that spill at the corners of the TIF, from its samples [across, along].
    pub fn corners(&self, samples: &Array2<f64>) -> Corners {
        let last = self.along.last;
        let beyond = keys::split(self.along.edge).0 + 1;
        let nodes: Vec<isize> = (-2..=0).chain(beyond.max(1)..=last + 2).collect();
        assert!(nodes.len() <= MAX_BORDER && self.border.len() <= MAX_BORDER, "nodes of a corner");
        let corners = self.border.iter().map(|(j, _)| {
            let mut corner = [[0.0; MAX_BORDER]; 4];
            for (e, of_weight) in (-1..=2).zip(&mut corner) {
                for (c, v) in nodes.iter().zip(of_weight) {
                    if (-1..=last).contains(&(c - e)) {
                        *v = samples[[(j + 1) as usize, (c - e + 1) as usize]];
                    }
                }
            }
            corner
        });
        Corners { samples: corners.collect(), nodes }
    }

    /// Returns the index in `border` of the spilling sample j.
    #[inline(always)]
    fn slot(&self, j: isize) -> usize {
        (if j <= 1 { j + 1 } else { j - self.across.last + self.border.len() as isize - 1 })
            as usize
    }

    /// Calls `add(line, pixel, rate)` with the removal rate `E ly lx`, nm/s, of one place at its corners. These are
    /// pixels beyond an edge across and beyond an edge along the lines. `upper` chooses the edge across. Lines outside
    /// of the range are left out, and the fraction of the place is not in the rate.
    ///
    /// ```text
    /// rate[k, c] = sum_d wy_d sum_e wx_e g[k - d, c - e]
    /// ```
    #[inline(always)]
    fn corner(
        &self,
        p: &Placed,
        group: &Group,
        upper: bool,
        corners: &Corners,
        range: &Range<isize>,
        mut add: impl FnMut(usize, usize, f64),
    ) {
        let lines = self.lines_beyond(group, upper);
        let first = *lines.start();
        let end = *lines.end();
        if group.cell + end < range.start || group.cell + first >= range.end {
            return;
        }
        let (wy, wx) = self.weights(p);
        let [low, high] = self.along.spills(p.offset[1]);
        let pixels = 0..self.along.pixels as isize;
        // h[j, c] = sum_e w_e g[j, c - e] of the samples j = k - d that these lines get something from
        let rows = if upper { (first - 2).max(-1)..=self.across.last } else { -1..=end + 1 };
        let from = self.slot(*rows.start());
        let mut h = [[0.0; MAX_BORDER]; MAX_BORDER];
        for (h, g) in h.iter_mut().zip(&corners.samples[from..=self.slot(*rows.end())]) {
            for (w, g) in wx.iter().zip(g) {
                for i in 0..MAX_BORDER {
                    h[i] += w * g[i];
                }
            }
        }
        for k in first..=end {
            let line = group.cell + k;
            if !range.contains(&line) {
                continue;
            }
            let mut rates = [0.0; MAX_BORDER];
            for d in self.weights_of(k, upper) {
                let w = wy[(d + 1) as usize];
                let h = &h[self.slot(k - d) - from];
                for i in 0..MAX_BORDER {
                    rates[i] += w * h[i];
                }
            }
            for (c, rate) in corners.nodes.iter().zip(rates) {
                let pixel = p.cell[1] as isize + c;
                if (*c <= low || *c >= high) && pixels.contains(&pixel) {
                    add(line as usize, pixel as usize, rate);
                }
            }
        }
    }

    /// Subtracts the adjoint of [`Self::spill`], with the same `corners`, applied to a map (across, along), from
    /// `sums`, one number for each column.
    pub fn subtract_spill(
        &self,
        map: ArrayView2<f64>,
        corners: Option<&Corners>,
        sums: &mut [f64],
    ) {
        let half = self.lines.half();
        let mut values = vec![0.0; self.places.len()];
        // Groups of LINES_PER_TASK cells, and their places.
        let mut bands: Vec<(&[Group], &mut [f64])> = Vec::new();
        let mut rest = values.as_mut_slice();
        for groups in self.groups.chunk_by(|a, b| {
            a.cell.div_euclid(LINES_PER_TASK as isize) == b.cell.div_euclid(LINES_PER_TASK as isize)
        }) {
            let count = groups.iter().map(|g| g.places.len()).sum();
            let (own, others) = std::mem::take(&mut rest).split_at_mut(count);
            rest = others;
            bands.push((groups, own));
        }
        let lines = 0..self.across.pixels as isize;
        parallel::consume_with(
            bands,
            &|| (self.lines.workspace(), vec![Complex64::default(); half]),
            &|(work, sum), _, (groups, values)| {
                // Spectra of the lines that are needed, by their number.
                let mut spectra: Vec<(isize, Vec<Complex64>)> = Vec::new();
                if let Some(corners) = corners {
                    self.subtract_corners(groups, map, corners, values);
                }
                let mut values = values.iter_mut();
                for group in groups {
                    let mut field = Vec::new();
                    for d in -1..=2 {
                        sum.fill(Complex64::default());
                        let mut used = false;
                        for upper in [false, true] {
                            for (k, _) in self.pairs(group, upper).filter(|p| p.1 == d) {
                                let line = group.cell + k;
                                let Some(g) = self.sample(k - d).filter(|_| lines.contains(&line))
                                else {
                                    continue;
                                };
                                let known = spectra.iter().position(|(l, _)| *l == line);
                                let index = known.unwrap_or_else(|| {
                                    let mut spectrum = vec![Complex64::default(); half];
                                    let write = |to: &mut [f64]| {
                                        let to = &mut to[self.along.last as usize + 1..];
                                        let from = map.row(line as usize);
                                        to.iter_mut().zip(from).for_each(|(t, m)| *t = *m);
                                    };
                                    self.lines.forward(write, &mut spectrum, work);
                                    spectra.push((line, spectrum));
                                    spectra.len() - 1
                                });
                                used = true;
                                add_conjugate_products(sum, &spectra[index].1, g);
                            }
                        }
                        if used {
                            field.push((d, self.lines.inverse(sum, work).to_vec()));
                        }
                    }
                    for p in &self.places[group.places.clone()] {
                        let (across, along) = self.weights(p);
                        let under = self.sources_under(p);
                        let spills = field.iter().map(|(d, field): &(isize, Vec<f64>)| {
                            across[(d + 1) as usize] * under.sum(&along, field)
                        });
                        *values.next().expect("one for each place") += spills.sum::<f64>();
                    }
                }
            },
        );
        for (p, spill) in self.places.iter().zip(&values) {
            sums[p.column as usize] -= p.fraction * spill;
        }
    }

    /// Subtracts, from the value of each place of some groups, the sum of a map times its removal rate at its corners.
    fn subtract_corners(
        &self,
        groups: &[Group],
        map: ArrayView2<f64>,
        corners: &Corners,
        values: &mut [f64],
    ) {
        let all = map.as_slice().expect("in C order");
        let lines = 0..self.across.pixels as isize;
        let pixels = self.along.pixels;
        vectorised(
            #[inline(always)]
            || {
                let mut values = values.iter_mut();
                for group in groups {
                    for (p, value) in self.places[group.places.clone()].iter().zip(&mut values) {
                        for upper in [false, true] {
                            self.corner(p, group, upper, corners, &lines, |r, c, rate| {
                                *value -= all[r * pixels + c] * rate;
                            });
                        }
                    }
                }
            },
        );
    }
}
