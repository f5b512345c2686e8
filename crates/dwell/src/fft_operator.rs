//! The removal model without a matrix: `B t` by spreading the dwell times on the pixels of the map
//! and one FFT convolution, for problems of any size.
//!
//! ```text
//! B = E - E ly - E lx + E ly lx,   E = C S                                                (1)
//! S: dwell times -> seconds on the lattice (Keys' weights),   C: convolution with the samples of R
//! ```
//!
//! E is what Keys' interpolation of the samples and their ghost nodes gives everywhere; R ends at its
//! last samples. `ly` and `lx` are the indicators of the pixel rows and columns beyond them, at most
//! three on each side of the TIF that E still reaches. A spilling row k of a tool in cell C at the
//! offset f holds few samples,
//!
//! ```text
//! (E ly)[C + k, :] = sum_d w_d(f) g[k - d, :] * (seconds along the row)                   (2)
//! ```
//!
//! so (1) takes convolutions along rows and columns, one transform for each cell and d, and a few
//! pixels for each corner. Nothing is approximated for a TIF on the pixels of the map: only sums are
//! reordered. A TIF of another pitch is first sampled anew at that of the map, by its own
//! interpolation, and continued by ghost nodes beyond its edge.

use std::ops::Range;

use ndarray::{Array2, ArrayView2, Axis as NdAxis, s};
use planish_numerics::{
    fft::line,
    fft::{Complex64, convolution::Convolution},
    keys,
};
use planish_types::{Axis, Grid, Tif};
use rayon::prelude::*;

use crate::columns::{Patch, Place};

/// B of [`crate::columns`] as an operator.
pub struct FftOperator {
    columns: usize,
    /// g[j], j = -1 ..= last on both axes.
    samples: Array2<f64>,
    convolution: Convolution,
    rows: Across,
    /// Transposed.
    columns_across: Across,
    spills: bool,
}

/// The places in the order of their cells across, [across, along].
struct Across {
    across: Lattice,
    along: Lattice,
    places: Vec<Placed>,
    groups: Vec<Group>,
    lines: line::Lines,
    /// Spectra of the samples that spill: j of the first, and one for each.
    border: Vec<(isize, Vec<Complex64>)>,
}

/// A tool on the lattice; [across, along].
#[derive(Clone, Copy)]
struct Placed {
    cell: [i32; 2],
    offset: [f64; 2],
    fraction: f64,
    column: u32,
}

/// Places of one cell across that spill into the same lines.
struct Group {
    cell: isize,
    /// Lines up to this one and from this one on spill.
    spills: [isize; 2],
    places: Range<usize>,
}

/// Lines that one thread takes at a time.
const BAND: usize = 32;

/// Samples below this fraction of the peak do not spill.
const NEGLIGIBLE_SPILL: f64 = 1e-14;

impl FftOperator {
    /// Plans for the columns of one path, TIF and map.
    pub fn new(places: &[Vec<Place>], tif: &Tif, grid: &Grid) -> Self {
        Self::with_border(places, tif, grid, true)
    }

    /// E alone, of samples that are continued by zeros: for a surrogate, whose samples are few, so that
    /// ghost nodes would be far from R.
    pub fn without_border(places: &[Vec<Place>], tif: &Tif, grid: &Grid) -> Self {
        Self::with_border(places, tif, grid, false)
    }

    fn with_border(places: &[Vec<Place>], tif: &Tif, grid: &Grid, border: bool) -> Self {
        let x = Lattice::new(&grid.x, &tif.grid().x);
        let y = Lattice::new(&grid.y, &tif.grid().y);
        let mut samples = samples(tif, &x, &y);
        if !border {
            samples = without_ghosts(samples);
        }
        let convolution = Convolution::new(samples.view(), (y.sources(), x.sources()));
        let placed = placed(places, &x, &y);
        let swap = |p: &Placed| Placed {
            cell: [p.cell[1], p.cell[0]],
            offset: [p.offset[1], p.offset[0]],
            ..*p
        };
        let swapped = placed.iter().map(swap).collect();
        let rows = Across::new(y, x, samples.view(), placed);
        let columns_across = Across::new(x, y, samples.t(), swapped);
        let peak = samples.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        let (my, mx) = samples.dim();
        let spills = border
            && samples.indexed_iter().any(|((r, c), v)| {
                let at_border = |k: usize, n: usize| k <= 2 || k + 4 >= n;
                (at_border(r, my) || at_border(c, mx)) && v.abs() > NEGLIGIBLE_SPILL * peak
            });
        Self { columns: places.len(), samples, convolution, rows, columns_across, spills }
    }

    /// Whether (1) is exact: the TIF has the pitch of the map.
    pub fn is_exact(tif: &Tif, grid: &Grid) -> bool {
        Lattice::new(&grid.x, &tif.grid().x).own && Lattice::new(&grid.y, &tif.grid().y).own
    }

    /// `B t`: (ny, nx), nm.
    pub fn apply(&self, t: &[f64]) -> Array2<f64> {
        let mut map = self.convolution.valid(self.rows.seconds(t).view());
        if self.spills {
            map -= &self.rows.spill(t, Some(&self.samples));
            let spill = self.columns_across.spill(t, None);
            map.axis_chunks_iter_mut(NdAxis(0), BAND)
                .into_par_iter()
                .zip(spill.axis_chunks_iter(NdAxis(1), BAND))
                .for_each(|(mut map, spill)| map -= &spill.t());
        }
        map
    }

    /// `B' m` for a map (ny, nx).
    pub fn adjoint(&self, map: &Array2<f64>) -> Vec<f64> {
        let mut sums = self.adjoint_with_spill(map);
        if self.spills {
            self.rows.subtract_spill(map.view(), Some(&self.samples), &mut sums);
            let transposed = map.t().as_standard_layout().into_owned();
            self.columns_across.subtract_spill(transposed.view(), None, &mut sums);
        }
        sums
    }

    /// `E' m`.
    pub fn adjoint_with_spill(&self, map: &Array2<f64>) -> Vec<f64> {
        self.rows.gather(&self.convolution.adjoint(map.view()), self.columns)
    }

    /// `B' m` with R^2 in place of R, but for what spills.
    pub fn adjoint_of_squared_tif(&self, map: &Array2<f64>) -> Vec<f64> {
        let squared = self.samples.mapv(|r| r * r);
        let shape = (self.rows.across.sources(), self.rows.along.sources());
        let field = Convolution::new(squared.view(), shape).adjoint(map.view());
        self.rows.gather(&field, self.columns)
    }
}

/// Sums of a few columns of [`FftOperator::without_border`], on the pixels that they reach.
pub struct Sums {
    x: Lattice,
    y: Lattice,
    placed: Vec<Placed>,
    /// The places of column j are `first[j] .. first[j + 1]`.
    first: Vec<u32>,
    /// Nodes (y, x) under which `correlation` is planned.
    room: (usize, usize),
    correlation: Convolution,
}

impl Sums {
    /// For columns whose places are within a square of `size_mm`.
    pub fn new(places: &[Vec<Place>], tif: &Tif, grid: &Grid, size_mm: f64) -> Self {
        let x = Lattice::new(&grid.x, &tif.grid().x);
        let y = Lattice::new(&grid.y, &tif.grid().y);
        // In the order of the columns.
        let placed = placed(places, &x, &y);
        let before = |j: usize| placed.partition_point(|p| (p.column as usize) < j) as u32;
        let first = (0..=places.len()).map(before).collect();
        let nodes = |l: &Lattice| (size_mm / l.step_mm).ceil() as usize + 5;
        let room = (nodes(&y), nodes(&x));
        let correlation = full_correlation(&without_ghosts(samples(tif, &x, &y)), room);
        Self { x, y, placed, first, room, correlation }
    }

    fn places(&self, column: usize) -> &[Placed] {
        &self.placed[self.first[column] as usize..self.first[column + 1] as usize]
    }

    /// First and last nodes [y, x] that the columns are spread on.
    fn nodes(&self, columns: impl Iterator<Item = usize>) -> Option<[[isize; 2]; 2]> {
        let cells = columns.flat_map(|j| self.places(j)).map(|p| p.cell.map(|c| c as isize));
        let ends = cells.map(|c| [c.map(|c| c - 1), c.map(|c| c + 2)]);
        ends.reduce(|[a, b], [c, d]| {
            [[a[0].min(c[0]), a[1].min(c[1])], [b[0].max(d[0]), b[1].max(d[1])]]
        })
    }

    /// Pixels (y, x) that nodes reach.
    fn pixels(&self, [low, high]: [[isize; 2]; 2]) -> (Range<usize>, Range<usize>) {
        let range = |axis: usize, l: &Lattice| {
            let to = (high[axis] + l.last + 1).clamp(0, l.pixels as isize) as usize;
            ((low[axis] - 1).max(0) as usize).min(to)..to
        };
        (range(0, &self.y), range(1, &self.x))
    }

    /// Pixels (y, x) that the columns reach.
    pub fn extent(&self, columns: impl Iterator<Item = usize>) -> (Range<usize>, Range<usize>) {
        self.nodes(columns).map_or((0..0, 0..0), |nodes| self.pixels(nodes))
    }

    /// `sum_j t_j B_j` for columns j and their t_j.
    pub fn patch(&self, t: &[(usize, f64)]) -> Patch {
        let Some(nodes) = self.nodes(t.iter().map(|(j, _)| *j)) else { return Patch::default() };
        let (rows, columns) = self.pixels(nodes);
        if rows.is_empty() || columns.is_empty() {
            return Patch::default();
        }
        let [low, high] = nodes;
        let shape = |axis: usize| (high[axis] - low[axis] + 1) as usize;
        let fits = shape(0) <= self.room.0 && shape(1) <= self.room.1;
        assert!(fits, "columns within the planned square");
        let mut seconds = Array2::zeros(self.room);
        for (p, t) in t.iter().flat_map(|(j, t)| self.places(*j).iter().map(move |p| (p, t))) {
            let (wy, wx) = (keys::weights(p.offset[0]), keys::weights(p.offset[1]));
            let at = |axis: usize| (p.cell[axis] as isize - 1 - low[axis]) as usize;
            for (r, wy) in wy.iter().enumerate() {
                for (c, wx) in wx.iter().enumerate() {
                    seconds[[at(0) + r, at(1) + c]] += t * p.fraction * wy * wx;
                }
            }
        }
        // From the pixel before the first node on.
        let all = self.correlation.adjoint(seconds.view());
        let from = |axis: usize, first: usize| (first as isize - low[axis] + 1) as usize;
        let (r, c) = (from(0, rows.start), from(1, columns.start));
        let rate = all.slice(s![r..r + rows.len(), c..c + columns.len()]).to_owned();
        Patch { origin: (rows.start, columns.start), rate_nm_per_s: rate }
    }
}

/// The tools of all columns that reach the map, in the order of the columns.
fn placed(places: &[Vec<Place>], x: &Lattice, y: &Lattice) -> Vec<Placed> {
    let each = places.iter().enumerate().flat_map(|(j, places)| places.iter().map(move |p| (j, p)));
    each.filter_map(|(j, Place { position_mm: p, fraction })| {
        let ((cy, fy), (cx, fx)) = (y.place(p[1])?, x.place(p[0])?);
        let (cell, offset) = ([cy, cx], [fy, fx]);
        Some(Placed { cell, offset, fraction: *fraction, column: j as u32 })
    })
    .collect()
}

/// The convolution of `samples` with all of a source of shape `room`, as an adjoint.
fn full_correlation(samples: &Array2<f64>, room: (usize, usize)) -> Convolution {
    let (my, mx) = samples.dim();
    let reversed = samples.slice(s![..;-1, ..;-1]);
    Convolution::new(reversed, (room.0 + my - 1, room.1 + mx - 1))
}

/// Zeros in place of the ghost nodes.
fn without_ghosts(mut samples: Array2<f64>) -> Array2<f64> {
    let (my, mx) = samples.dim();
    samples.slice_mut(s![..;my - 1, ..]).fill(0.0);
    samples.slice_mut(s![.., ..;mx - 1]).fill(0.0);
    samples
}

/// R at the pixels of the map, with a ghost node before its lower edge and up to two beyond its upper
/// one.
fn samples(tif: &Tif, x: &Lattice, y: &Lattice) -> Array2<f64> {
    if x.own && y.own {
        return tif.with_ghosts().clone();
    }
    let inside = |l: &Lattice| keys::split(l.edge).0 as usize + 1;
    let (ny, nx) = (inside(y), inside(x));
    let mut g = keys::with_ghosts(
        Array2::from_shape_fn((ny, nx), |(j, i)| tif.rate_at(x.offset_mm(i), y.offset_mm(j)))
            .view(),
    );
    // An edge between two nodes needs one more beyond it.
    for axis in [NdAxis(0), NdAxis(1)] {
        let lattice = if axis.index() == 0 { y } else { x };
        while g.len_of(axis) < lattice.kernel() {
            let n = g.len_of(axis);
            let next = match n {
                0..=2 => g.index_axis(axis, n - 1).to_owned(),
                _ => {
                    let at = |k: usize| g.index_axis(axis, n - k);
                    &at(1) * 3.0 - &(&at(2) * 3.0) + at(3)
                }
            };
            g.push(axis, next.view()).expect("a line of the array");
        }
    }
    g.as_standard_layout().into_owned()
}

impl Across {
    /// `samples` [across, along].
    fn new(
        across: Lattice,
        along: Lattice,
        samples: ArrayView2<f64>,
        mut places: Vec<Placed>,
    ) -> Self {
        let key = |p: &Placed| (p.cell[0], across.spills(p.offset[0]));
        places.sort_by_key(key);
        let mut groups: Vec<Group> = Vec::new();
        for (i, p) in places.iter().enumerate() {
            let (cell, spills) = (p.cell[0] as isize, across.spills(p.offset[0]));
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
                let write = |line: &mut [f64]| line.iter_mut().zip(g).for_each(|(l, g)| *l = *g);
                lines.forward(write, &mut spectrum, &mut work);
                (j, spectrum)
            })
            .collect();
        Self { across, along, places, groups, lines, border }
    }

    fn sample(&self, j: isize) -> Option<&[Complex64]> {
        self.border.iter().find(|(k, _)| *k == j).map(|(_, g)| g.as_slice())
    }

    /// Groups with a cell in the range.
    fn within(&self, cells: Range<isize>) -> &[Group] {
        let at = |cell: isize| self.groups.partition_point(|g| g.cell < cell);
        let (from, to) = (at(cells.start), at(cells.end));
        &self.groups[from..to.max(from)]
    }

    /// S t.
    fn seconds(&self, t: &[f64]) -> Array2<f64> {
        let mut seconds = Array2::zeros((self.across.sources(), self.along.sources()));
        seconds.outer_iter_mut().into_par_iter().enumerate().for_each(|(r, mut row)| {
            let row = row.as_slice_mut().expect("in C order");
            let node = r as isize - self.across.last;
            for group in self.within(node - 2..node + 2) {
                self.spread(group, node - group.cell, t, row);
            }
        });
        seconds
    }

    /// Adds the seconds of the node d of a group, with the weights along.
    fn spread(&self, group: &Group, d: isize, t: &[f64], line: &mut [f64]) {
        for p in &self.places[group.places.clone()] {
            let seconds =
                t[p.column as usize] * p.fraction * keys::weights(p.offset[0])[(d + 1) as usize];
            let w = keys::weights(p.offset[1]);
            let first = p.cell[1] as isize - 1 + self.along.last;
            for (i, w) in w.iter().enumerate() {
                let at = first + i as isize;
                if at >= 0 && (at as usize) < self.along.sources() {
                    line[at as usize] += w * seconds;
                }
            }
        }
    }

    /// `S' f`, summed by columns.
    fn gather(&self, field: &Array2<f64>, columns: usize) -> Vec<f64> {
        let field = field.as_slice().expect("in C order");
        let (height, width) = (self.across.sources() as isize, self.along.sources());
        let of = |p: &Placed| {
            let w = keys::weights(p.offset[0]);
            let first = p.cell[0] as isize - 1 + self.across.last;
            let mut sum = 0.0;
            for (i, w) in w.iter().enumerate() {
                let r = first + i as isize;
                if r >= 0 && r < height {
                    let r = r as usize * width;
                    sum += w * self.along_sum(p, &field[r..r + width]);
                }
            }
            sum
        };
        let values: Vec<f64> = self.places.par_iter().map(of).collect();
        let mut sums = vec![0.0; columns];
        for (p, v) in self.places.iter().zip(&values) {
            sums[p.column as usize] += p.fraction * v;
        }
        sums
    }

    /// A line of sources with the weights along.
    fn along_sum(&self, p: &Placed, line: &[f64]) -> f64 {
        let first = p.cell[1] as isize - 1 + self.along.last;
        let of = |(i, w): (usize, &f64)| {
            let at = usize::try_from(first + i as isize).ok();
            at.and_then(|at| line.get(at)).map_or(0.0, |v| w * v)
        };
        keys::weights(p.offset[1]).iter().enumerate().map(of).sum()
    }

    /// The pairs (k, d) at which a group spills, of its lower or its upper edge.
    fn pairs(&self, group: &Group, upper: bool) -> impl Iterator<Item = (isize, isize)> {
        let last = self.across.last;
        let k = if upper { group.spills[1]..=last + 2 } else { -2..=group.spills[0] };
        k.flat_map(move |k| {
            let d = if upper { (k - last).max(-1)..=2 } else { -1..=(k + 1).min(2) };
            d.map(move |d| (k, d))
        })
    }

    /// Cells that spill into lines of the range, over their lower or their upper edge.
    fn cells(&self, lines: &Range<isize>, upper: bool) -> Range<isize> {
        if upper {
            lines.start - self.across.last - 2..lines.end - self.across.edge.floor() as isize
        } else {
            lines.start..lines.end + 2
        }
    }

    /// (2): lines of the map; with `corners` (the samples) what spills over both edges is left out.
    fn spill(&self, t: &[f64], corners: Option<&Array2<f64>>) -> Array2<f64> {
        let pixels = self.along.pixels;
        let mut map = Array2::zeros((self.across.pixels, pixels));
        let half = self.lines.half();
        map.axis_chunks_iter_mut(NdAxis(0), BAND).into_par_iter().enumerate().for_each_init(
            || (self.lines.workspace(), vec![Complex64::default(); half]),
            |(work, seconds), (b, mut band)| {
                let range = (b * BAND) as isize..(b * BAND + band.nrows()) as isize;
                let mut sums = vec![Complex64::default(); half * band.nrows()];
                let mut used = vec![false; band.nrows()];
                for upper in [false, true] {
                    for group in self.within(self.cells(&range, upper)) {
                        for d in -1..=2 {
                            let mut known = false;
                            for (k, _) in self.pairs(group, upper).filter(|p| p.1 == d) {
                                let (line, j) = (group.cell + k, k - d);
                                let Some(g) = self.sample(j).filter(|_| range.contains(&line))
                                else {
                                    continue;
                                };
                                if !known {
                                    known = true;
                                    let write = |line: &mut [f64]| self.spread(group, d, t, line);
                                    self.lines.forward(write, seconds, work);
                                }
                                let r = (line - range.start) as usize;
                                used[r] = true;
                                let sum = &mut sums[r * half..(r + 1) * half];
                                for ((sum, s), g) in sum.iter_mut().zip(&*seconds).zip(g) {
                                    *sum += s * g;
                                }
                            }
                        }
                    }
                }
                for (r, mut row) in band.outer_iter_mut().enumerate().filter(|(r, _)| used[*r]) {
                    let line = self.lines.inverse(&sums[r * half..(r + 1) * half], work);
                    let from = self.along.last as usize + 1;
                    row.iter_mut().zip(&line[from..]).for_each(|(v, l)| *v = *l);
                }
                let Some(samples) = corners else { return };
                for upper in [false, true] {
                    for group in self.within(self.cells(&range, upper)) {
                        for p in &self.places[group.places.clone()] {
                            let seconds = t[p.column as usize] * p.fraction;
                            self.corner(p, group, upper, samples, &range, |r, c, rate| {
                                band[[r - range.start as usize, c]] -= seconds * rate;
                            });
                        }
                    }
                }
            },
        );
        map
    }

    /// `E ly lx` of one tool on the lines of the range: (line, pixel, rate).
    fn corner(
        &self,
        p: &Placed,
        group: &Group,
        upper: bool,
        samples: &Array2<f64>,
        range: &Range<isize>,
        mut add: impl FnMut(usize, usize, f64),
    ) {
        let (wy, wx) = (keys::weights(p.offset[0]), keys::weights(p.offset[1]));
        let along = &self.along;
        let [low, high] = along.spills(p.offset[1]);
        let mut of_pixel = |c: isize, from: isize, to: isize| {
            let pixel = p.cell[1] as isize + c;
            if pixel < 0 || pixel >= along.pixels as isize {
                return;
            }
            let mut lines = [(0, 0.0); 8];
            let mut count = 0;
            for (k, d) in self.pairs(group, upper) {
                let line = group.cell + k;
                if !range.contains(&line) {
                    continue;
                }
                let row = samples.row((k - d + 1) as usize);
                let rate: f64 =
                    (from..=to).map(|e| wx[(e + 1) as usize] * row[(c - e + 1) as usize]).sum();
                if count == 0 || lines[count - 1].0 != line {
                    lines[count] = (line, 0.0);
                    count += 1;
                }
                lines[count - 1].1 += wy[(d + 1) as usize] * rate;
            }
            for (line, rate) in &lines[..count] {
                add(*line as usize, pixel as usize, *rate);
            }
        };
        for c in -2..=low {
            of_pixel(c, -1, (c + 1).min(2));
        }
        for c in high..=along.last + 2 {
            of_pixel(c, (c - along.last).max(-1), 2);
        }
    }

    /// Subtracts the adjoint of [`Self::spill`] from the sums of the columns.
    fn subtract_spill(
        &self,
        map: ArrayView2<f64>,
        corners: Option<&Array2<f64>>,
        sums: &mut [f64],
    ) {
        let half = self.lines.half();
        let mut values = vec![0.0; self.places.len()];
        // Groups of BAND cells, and their places.
        let mut bands: Vec<(&[Group], &mut [f64])> = Vec::new();
        let mut rest = values.as_mut_slice();
        for groups in self
            .groups
            .chunk_by(|a, b| a.cell.div_euclid(BAND as isize) == b.cell.div_euclid(BAND as isize))
        {
            let count = groups.iter().map(|g| g.places.len()).sum();
            let (own, others) = std::mem::take(&mut rest).split_at_mut(count);
            rest = others;
            bands.push((groups, own));
        }
        let lines = 0..self.across.pixels as isize;
        bands.into_par_iter().for_each_init(
            || (self.lines.workspace(), vec![Complex64::default(); half]),
            |(work, sum), (groups, values)| {
                // Spectra of the lines that are needed, by their number.
                let mut spectra: Vec<(isize, Vec<Complex64>)> = Vec::new();
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
                                let at = known.unwrap_or_else(|| {
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
                                for ((sum, m), g) in sum.iter_mut().zip(&spectra[at].1).zip(g) {
                                    *sum += m * g.conj();
                                }
                            }
                        }
                        if used {
                            field.push((d, self.lines.inverse(sum, work).to_vec()));
                        }
                    }
                    for p in &self.places[group.places.clone()] {
                        let w = keys::weights(p.offset[0]);
                        let of = |(d, field): &(isize, Vec<f64>)| {
                            w[(d + 1) as usize] * self.along_sum(p, &field[..self.along.sources()])
                        };
                        let mut spill: f64 = field.iter().map(of).sum();
                        if let Some(samples) = corners {
                            for upper in [false, true] {
                                self.corner(p, group, upper, samples, &lines, |r, c, rate| {
                                    spill -= map[[r, c]] * rate;
                                });
                            }
                        }
                        *values.next().expect("one for each place") = spill;
                    }
                }
            },
        );
        for (p, spill) in self.places.iter().zip(&values) {
            sums[p.column as usize] -= p.fraction * spill;
        }
    }
}

/// One axis: pixel i of the map, sample j of R, j = -1 ..= last.
#[derive(Clone, Copy)]
struct Lattice {
    start_mm: f64,
    step_mm: f64,
    pixels: usize,
    tif_start_mm: f64,
    tif_end_mm: f64,
    /// Whether the samples of the TIF have the pitch of the map.
    own: bool,
    /// Upper edge of R, in pixels from the lower one.
    edge: f64,
    last: isize,
}

impl Lattice {
    fn new(map: &Axis, tif: &Axis) -> Self {
        // The tolerance of a shared pitch that is rounded differently in the two files.
        let steps = (tif.len() - 1) as f64;
        let own = (map.step_mm() / tif.step_mm() - 1.0).abs() * steps <= 1e-4;
        let edge = if own { steps } else { (tif.end_mm() - tif.start_mm()) / map.step_mm() };
        let (whole, fraction) = keys::split(edge);
        Self {
            start_mm: map.start_mm(),
            step_mm: map.step_mm(),
            pixels: map.len(),
            tif_start_mm: tif.start_mm(),
            tif_end_mm: tif.end_mm(),
            own,
            edge,
            last: whole + if fraction > 0.0 { 2 } else { 1 },
        }
    }

    fn offset_mm(&self, j: usize) -> f64 {
        (self.tif_start_mm + j as f64 * self.step_mm).min(self.tif_end_mm)
    }

    /// Samples with ghost nodes.
    fn kernel(&self) -> usize {
        self.last as usize + 2
    }

    /// Nodes -last ..= pixels, from which a sample reaches a pixel.
    fn sources(&self) -> usize {
        self.pixels + self.last as usize + 1
    }

    /// Cell and offset of a tool that reaches the map.
    fn place(&self, p: f64) -> Option<(i32, f64)> {
        let (cell, f) = keys::split((p + self.tif_start_mm - self.start_mm) / self.step_mm);
        let reaches = cell >= -self.last - 2 && cell <= self.pixels as isize + 1;
        reaches.then_some((cell as i32, f))
    }

    /// Up to the first and from the second k on, pixel C + k is beyond R: k - f outside [0, edge].
    fn spills(&self, f: f64) -> [isize; 2] {
        let low = if f > 0.0 { 0 } else { -1 };
        let (whole, _) = keys::split(self.edge + f);
        [low, whole + 1]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::columns::{self, Columns};
    use planish_types::ToolPath;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn case(border: f64) -> (ToolPath, Tif, Grid) {
        let axis = |n: usize| Axis::new(-0.1 * (n / 2) as f64, 0.1, n).unwrap();
        let g = Grid { x: axis(31), y: axis(25) };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (x, y) = (g.x.at(c) / 1.5, g.y.at(r) / 1.2);
            border + (1.0 + x + 0.5 * y) * ((1.0 - x * x) * (1.0 - y * y)).max(0.0).powi(6)
        });
        let map =
            Grid { x: Axis::new(0.03, 0.1, 60).unwrap(), y: Axis::new(-0.4, 0.1, 45).unwrap() };
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let points: Vec<[f64; 2]> =
            (0..40).map(|_| [rng.random_range(-2.0..8.0), rng.random_range(-2.0..6.0)]).collect();
        let n = points.len() - 1;
        (
            ToolPath::through(points, vec![true; n], vec![0; n]).unwrap(),
            Tif::new(g, rate).unwrap(),
            map,
        )
    }

    /// B t by its columns.
    fn by_columns(places: &[Vec<Place>], tif: &Tif, map: &Grid, t: &[f64]) -> Array2<f64> {
        let mut removal = Array2::zeros(map.shape());
        for (p, t) in columns::patches(places, tif, map).iter().zip(t) {
            let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
            removal.slice_mut(s![r..r + ny, c..c + nx]).scaled_add(*t, &p.rate_nm_per_s);
        }
        removal
    }

    fn largest(map: &Array2<f64>) -> f64 {
        map.iter().fold(0.0, |m, v| m.max(v.abs()))
    }

    /// Places on nodes, between them, and around the map, one in each column.
    fn places(map: &Grid) -> Vec<Vec<Place>> {
        let at = |axis: &Axis, k: usize| axis.start_mm() + k as f64 * 0.45 * axis.step_mm();
        (0..2600)
            .map(|j| {
                let (kx, ky) = ((7 * j) % 173, (11 * j) % 139);
                let p = [at(&map.x, kx) - 1.8, at(&map.y, ky) - 1.5];
                vec![Place { position_mm: p, fraction: 1.0 }]
            })
            .collect()
    }

    #[test]
    fn agrees_with_the_columns_whatever_the_border() {
        for border in [0.0, 0.3] {
            let (path, tif, map) = case(border);
            assert!(FftOperator::is_exact(&tif, &map));
            let cases =
                [Columns::Point.places(&path), Columns::Segment.places(&path), places(&map)];
            for places in &cases {
                let t: Vec<f64> = (0..places.len()).map(|j| 1.0 + (j as f64).sin()).collect();
                let operator = FftOperator::new(places, &tif, &map);
                let expected = by_columns(places, &tif, &map, &t);
                let error = largest(&(operator.apply(&t) - &expected)) / largest(&expected);
                // Sums of at most 2600 terms; a spill left in would be 1e-2.
                assert!(error < 1e-12, "border {border}, {} columns: {error}", places.len());
            }
        }
    }

    #[test]
    fn a_tif_of_another_pitch_has_its_border_too() {
        let (path, tif, _) = case(0.3);
        let coarse =
            Grid { x: Axis::new(0.03, 0.13, 46).unwrap(), y: Axis::new(-0.4, 0.11, 41).unwrap() };
        let places = Columns::Segment.places(&path);
        let t = vec![1.0; places.len()];
        let expected = by_columns(&places, &tif, &coarse, &t);
        let operator = FftOperator::new(&places, &tif, &coarse);
        let error = largest(&(operator.apply(&t) - &expected)) / largest(&expected);
        let spilling = FftOperator::without_border(&places, &tif, &coarse);
        let spill = largest(&(spilling.apply(&t) - &expected)) / largest(&expected);
        // Keys' interpolation of samples at 0.13 mm of a bell of 0.7 mm; the border is 0.3 of 1.3.
        assert!(error < 5e-3 && spill > 10.0 * error, "{error} {spill}");
    }

    #[test]
    fn sums_of_few_columns_are_those_of_the_operator() {
        let (path, tif, map) = case(0.3);
        let places = [Columns::Segment.places(&path), places(&map)].concat();
        let operator = FftOperator::without_border(&places, &tif, &map);
        let sums = Sums::new(&places, &tif, &map, 20.0);
        for columns in [0..3, 17..18, 40..200, 0..places.len()] {
            let t: Vec<(usize, f64)> = columns.map(|j| (j, 1.0 + (j as f64).cos())).collect();
            let mut all = vec![0.0; places.len()];
            t.iter().for_each(|(j, t)| all[*j] = *t);
            let expected = operator.apply(&all);
            let patch = sums.patch(&t);
            let (rows, columns) = sums.extent(t.iter().map(|t| t.0));
            assert_eq!(patch.origin, (rows.start, columns.start));
            let mut found = Array2::zeros(map.shape());
            found.slice_mut(s![rows, columns]).assign(&patch.rate_nm_per_s);
            // The two round differently.
            let error = largest(&(&found - &expected)) / largest(&expected).max(1e-300);
            assert!(error < 1e-12, "{} columns: {error}", t.len());
        }
    }

    #[test]
    fn the_adjoint_is_the_adjoint() {
        let (path, tif, map) = case(0.3);
        let places = [Columns::Segment.places(&path), places(&map)].concat();
        let operator = FftOperator::new(&places, &tif, &map);
        let t: Vec<f64> = (0..places.len()).map(|j| (0.7 * j as f64).cos()).collect();
        let m = Array2::from_shape_fn(map.shape(), |(r, c)| ((r * 3 + c) as f64).sin());
        let left = (&operator.apply(&t) * &m).sum();
        let right: f64 = operator.adjoint(&m).iter().zip(&t).map(|(b, t)| b * t).sum();
        let size = operator.apply(&t).mapv(|v| v * v).sum().sqrt() * m.mapv(|v| v * v).sum().sqrt();
        assert!((left - right).abs() <= 1e-12 * size, "{left} {right}");
    }
}
