//! The maze: one random line that passes every cell of a lattice once, never crosses itself, and
//! comes back to where it began.
//!
//! A path around a tree: cells of side p are grouped into blocks of 2 x 2, a random spanning tree
//! is drawn over the blocks, and the path walks around it with the tree on its left.
//!
//! ```text
//! cells    centres (x_mid + (i - (n_x-1)/2) p, y_mid + (j - (n_y-1)/2) p) in the region, which is
//!          the aperture (pixel centres) dilated by a square of half-width max(o, p/2, h/2);
//!          n_x = floor(W/p) + 1, W = extent of the region, h = pixel; the same for y
//! blocks   2 x 2 cells of the region; of the four phases of the lattice each connected part of
//!          the region takes the one with most blocks
//! start    every block is a loop of its four cells, counter-clockwise: E, N, W, S
//! join     for every edge of the tree the two facing, antiparallel steps a -> b, c -> d of the
//!          two loops become a -> d, c -> b: one loop instead of two, through the same cells
//! absorb   cells that no block holds, two by two: with a -> b and two free cells s, q on its
//!          right, a -> b becomes a -> s -> q -> b; first pairs in phase with the blocks, then any
//! join     loops that face each other still: now a region that its blocks tore apart is whole
//! corners  replaced by quarter circles of radius R <= p/2, then nodes every L / ceil(L/s)
//! ```
//!
//! Every step goes from a cell to its neighbour, and every cell has one step in and one out. So the
//! path cannot cross itself, and every turn is 0 or 90 degrees. A closed loop on a lattice has as
//! many black as white cells (of a chess board), so some cells at the rim may stay out. Parts of
//! the region that are still apart are passes of their own with a lift between them.
//!
//! Trees: depth-first goes on at random until it is stuck, then back to where it can go on (long
//! corridors); its straightness is the chance to keep the direction where that is possible.
//! Wilson's walks, cut of their loops, give every spanning tree the same chance (more turns).
//!
//! Sources: R. Dunn, J. Walker, "Pseudo-random tool paths for CNC sub-aperture polishing and
//! other applications", Opt. Express 16 (2008) 18942; C. Wang et al., "Highly efficient
//! deterministic polishing using a unicursal random path", Appl. Opt. 54 (2015);
//! D. B. Wilson, "Generating random spanning trees more quickly than the cover time", STOC 1996.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | p | `pitch_mm` | - | mm |
//! | s | `step_mm` | - | mm |
//! | o | `overscan_mm` | - | mm |
//! | R | `corner_radius_mm` | - | mm |
//! | a -> b | `next[a] = b` | (cells) | - |

use std::{collections::VecDeque, f64::consts::FRAC_PI_2};

use planish_types::{Invalid, Surface, ToolPath};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use crate::{
    MAX_SEGMENTS, ToolPathError,
    draft::{Draft, parts},
    region::{Aperture, SLACK, check_length},
};

/// Settings of a maze.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MazeSettings {
    /// Side of a cell: distance between neighbouring lanes, mm; > 0.
    pub pitch_mm: f64,
    /// Longest segment, mm; > 0. Steps between cells are never longer than the pitch.
    pub step_mm: f64,
    /// Distance that the region of the cells goes beyond the clear aperture, mm; >= 0. It is at least half the pitch
    /// and half a pixel.
    pub overscan_mm: f64,
    /// Radius of the corners, mm; from 0 (sharp) to half the pitch.
    pub corner_radius_mm: f64,
    /// Random tree around which the path goes.
    pub tree: Tree,
    /// True to leave out the step that leads back to the start, so that the path is open.
    pub open: bool,
    /// Seed of the random numbers (ChaCha8).
    pub seed: u64,
}

impl MazeSettings {
    /// Returns the default of the longest segment, mm: the side of a cell, or the radius of the corners if they are
    /// rounded.
    pub fn usual_step_mm(pitch_mm: f64, corner_radius_mm: f64) -> f64 {
        if corner_radius_mm > 0.0 { corner_radius_mm } else { pitch_mm }
    }
}

/// Random spanning tree of the blocks (2 x 2 cells), around which the path goes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Tree {
    /// Randomised depth-first search: long corridors.
    DepthFirst {
        /// Chance to keep the direction where that is possible, 0 to 1. At 0 all directions are
        /// alike, at 1 the path turns only where it must.
        straightness: f64,
    },
    /// Wilson's loop-erased random walks: every spanning tree is equally likely; more turns.
    Wilson,
}

/// A maze, and the number of cells that its path does not pass.
#[derive(Clone, Debug, PartialEq)]
pub struct Maze {
    /// The path; each connected part of the region is a pass of its own.
    pub path: ToolPath,
    /// Number of cells of the region.
    pub cells: usize,
    /// Number of cells of the region that the path does not pass.
    pub cells_left_out: usize,
}

/// Makes a maze over the valid pixels of `surface`.
///
/// # Errors
/// Refuses settings out of their range, an aperture into which no 2 x 2 cells fit, and too many cells or segments.
pub fn maze(surface: &Surface, settings: &MazeSettings) -> Result<Maze, ToolPathError> {
    check(settings)?;
    let lattice = Lattice::new(surface, settings)?;
    let blocks = Blocks::new(&lattice);
    if blocks.corners.is_empty() {
        return Err(lattice.too_thin());
    }
    let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
    let tree = match settings.tree {
        Tree::DepthFirst { straightness } => depth_first(&lattice, &blocks, straightness, &mut rng),
        Tree::Wilson => wilson(&lattice, &blocks, &mut rng),
    };
    let mut loops = Loops::around(&lattice, &blocks);
    for (block, side) in tree {
        loops.join(lattice.side_of(block, side));
    }
    loops.absorb(|s, q| blocks.in_phase(s.min(q), s.abs_diff(q) == 1));
    loops.absorb(|_, _| true);
    loops.join_the_facing();
    let tours = loops.tours();
    let path = walk(&lattice, &tours, settings).ok_or_else(|| lattice.too_many(settings))?;
    let cells = lattice.inside.iter().filter(|i| **i).count();
    let passed: usize = tours.iter().map(Vec::len).sum();
    Ok(Maze { path: path.finish()?, cells, cells_left_out: cells - passed })
}

fn check(settings: &MazeSettings) -> Result<(), Invalid> {
    let pitch = settings.pitch_mm;
    let radius = settings.corner_radius_mm;
    check_length("pitch_mm", pitch, false)?;
    check_length("step_mm", settings.step_mm, false)?;
    check_length("overscan_mm", settings.overscan_mm, true)?;
    check_length("corner_radius_mm", radius, true)?;
    if radius > 0.5 * pitch * (1.0 + SLACK) {
        let remedy =
            format!("two corners share a step of {pitch} mm: give a radius of at most half of it");
        return Err(Invalid::whole("corner_radius_mm", format!("is {radius}"), remedy));
    }
    match settings.tree {
        Tree::DepthFirst { straightness: s } if !(0.0..=1.0).contains(&s) => {
            Err(Invalid::whole("straightness", format!("is {s}"), "give a chance from 0 to 1"))
        }
        _ => Ok(()),
    }
}

/// Number of sides of a block; 0 to 3 stand for east, north, west and south, the order of its loop.
const SIDES: usize = 4;

/// Number of columns and rows outside the region on every side, so that a neighbour always has an
/// index. Larger: more memory. Smaller: neighbours of the border have no index.
const MARGIN: usize = 2;

/// Lattice of square cells, numbered row by row from the smallest y; `inside` is true for the cells of the region.
struct Lattice {
    /// Centre of cell 0, which lies in the margin, mm.
    origin_mm: [f64; 2],
    pitch_mm: f64,
    /// Extent of the region, mm.
    extent_mm: [f64; 2],
    /// Cells per row.
    width: usize,
    inside: Vec<bool>,
}

impl Lattice {
    fn new(surface: &Surface, settings: &MazeSettings) -> Result<Self, ToolPathError> {
        let p = settings.pitch_mm;
        let o = settings.overscan_mm;
        let grid = surface.grid();
        let aperture = Aperture::new(&grid.x, &grid.y, surface.height_nm().view());
        // max(o, p/2, h/2)
        let reach = aperture.pixel_mm.map(|h| o.max(0.5 * p).max(0.5 * h));
        let extents = [aperture.along(reach[0]), aperture.across(reach[1])];
        let extent_mm = extents.map(|e| e.high - e.low);
        // n = floor(W/p) + 1
        let count = extent_mm.map(|w| (w / p + SLACK).floor() + 1.0);
        let mut lattice = Self {
            origin_mm: [0, 1].map(|a| {
                0.5 * (extents[a].low + extents[a].high)
                    - (0.5 * (count[a] - 1.0) + MARGIN as f64) * p
            }),
            pitch_mm: p,
            extent_mm,
            width: 0,
            inside: Vec::new(),
        };
        // NaN when both are infinite.
        let cells = count[0] * count[1];
        if cells.is_nan() || cells > MAX_SEGMENTS as f64 {
            return Err(lattice.too_many(settings));
        }
        // Two cells side by side need a region as wide as the distance of their centres.
        let own = [0, 1].map(|a| extent_mm[a] - 2.0 * reach[a] + 2.0 * o + aperture.pixel_mm[a]);
        if own[0].min(own[1]) < p * (1.0 - SLACK) {
            return Err(ToolPathError::TooThin { pitch_mm: p, extent_mm: own });
        }
        let [nx, ny] = count.map(|n| n as usize);
        lattice.width = nx + 2 * MARGIN;
        lattice.inside = vec![false; lattice.width * (ny + 2 * MARGIN)];
        for row in MARGIN..MARGIN + ny {
            let y = lattice.origin_mm[1] + row as f64 * p;
            let within = reach[1] + SLACK * p;
            for stretch in aperture.stretches(y - within, y + within, reach[0], 0.0) {
                let first = ((stretch.low - lattice.origin_mm[0]) / p - SLACK).ceil() as usize;
                let last = ((stretch.high - lattice.origin_mm[0]) / p + SLACK).floor() as usize;
                for column in first.max(MARGIN)..=last.min(MARGIN + nx - 1) {
                    lattice.inside[row * lattice.width + column] = true;
                }
            }
        }
        Ok(lattice)
    }

    /// Returns the centre of a cell, mm.
    fn centre(&self, cell: usize) -> [f64; 2] {
        let index = [cell % self.width, cell / self.width];
        [0, 1].map(|a| self.origin_mm[a] + index[a] as f64 * self.pitch_mm)
    }

    /// Returns the number to add to the index of a cell to get its neighbour on that side (0 to 3: east, north, west,
    /// south).
    fn offset(&self, side: usize) -> isize {
        let w = self.width as isize;
        [1, w, -1, -w][side]
    }

    /// Returns the neighbour of a block on that side; blocks are given by the index of their south-western cell.
    fn beside(&self, block: usize, side: usize) -> usize {
        block.wrapping_add_signed(2 * self.offset(side))
    }

    /// Returns the cell of a block from which its counter-clockwise loop runs along that side (0 to 3: east, north,
    /// west, south).
    fn side_of(&self, block: usize, side: usize) -> usize {
        block + [1, self.width + 1, self.width, 0][side]
    }

    fn too_many(&self, settings: &MazeSettings) -> ToolPathError {
        let step_mm = settings.step_mm.min(settings.pitch_mm);
        let pitch_mm = settings.pitch_mm;
        let extent_mm = self.extent_mm;
        ToolPathError::TooManySegments { pitch_mm, step_mm, extent_mm }
    }

    fn too_thin(&self) -> ToolPathError {
        ToolPathError::TooThin { pitch_mm: self.pitch_mm, extent_mm: self.extent_mm }
    }
}

/// The blocks of 2 x 2 cells, each given by the index of its south-western cell.
struct Blocks {
    /// South-western cells of the blocks, in ascending order.
    corners: Vec<usize>,
    /// True for the cells that are the south-western one of a block.
    is_corner: Vec<bool>,
    /// Number of the connected part of the region that each cell belongs to; `u32::MAX` outside the region.
    part: Vec<u32>,
    /// Parity of (column, row) of the south-western cells of the blocks, for each connected part.
    phase: Vec<[usize; 2]>,
    width: usize,
}

impl Blocks {
    fn new(lattice: &Lattice) -> Self {
        let inside = &lattice.inside;
        let width = lattice.width;
        let (part, parts) = parts_of(lattice);
        let phase_of = |k: usize| [k % width % 2, k / width % 2];
        // A block is connected, so it lies in one part.
        let candidates: Vec<usize> = (0..inside.len() - width - 1)
            .filter(|k| inside[*k] && inside[k + 1] && inside[k + width] && inside[k + width + 1])
            .collect();
        let mut blocks = vec![[0_usize; 4]; parts];
        for k in &candidates {
            let [x, y] = phase_of(*k);
            blocks[part[*k] as usize][x + 2 * y] += 1;
        }
        let phases = blocks.iter().map(|n| {
            let most = (1..4).fold(0, |best, i| if n[i] > n[best] { i } else { best });
            [most % 2, most / 2]
        });
        let phase: Vec<[usize; 2]> = phases.collect();
        let mut corners = candidates;
        corners.retain(|k| phase_of(*k) == phase[part[*k] as usize]);
        let mut is_corner = vec![false; inside.len()];
        corners.iter().for_each(|k| is_corner[*k] = true);
        Self { corners, is_corner, part, phase, width }
    }

    /// Returns true if two neighbouring cells would be in one block of their connected part, if that had a block there.
    /// `low` has the smaller index, and `side_by_side` says that they lie in one row.
    fn in_phase(&self, low: usize, side_by_side: bool) -> bool {
        let [x, y] = self.phase[self.part[low] as usize];
        if side_by_side { low % self.width % 2 == x } else { low / self.width % 2 == y }
    }
}

/// Returns the number of the connected part of every cell (`u32::MAX` outside the region), and the number of parts.
fn parts_of(lattice: &Lattice) -> (Vec<u32>, usize) {
    let mut part = vec![u32::MAX; lattice.inside.len()];
    let mut count = 0;
    let mut open = Vec::new();
    for seed in 0..part.len() {
        if !lattice.inside[seed] || part[seed] != u32::MAX {
            continue;
        }
        part[seed] = count;
        open.push(seed);
        while let Some(k) = open.pop() {
            for side in 0..SIDES {
                let to = k.wrapping_add_signed(lattice.offset(side));
                if lattice.inside[to] && part[to] == u32::MAX {
                    part[to] = count;
                    open.push(to);
                }
            }
        }
        count += 1;
    }
    (part, count as usize)
}

/// Returns the edges (block, side) of a random depth-first spanning tree in every connected part of the blocks.
/// `straightness` is the chance to keep the direction, 0 to 1.
fn depth_first(
    lattice: &Lattice,
    blocks: &Blocks,
    straightness: f64,
    rng: &mut ChaCha8Rng,
) -> Vec<(usize, usize)> {
    let mut tree = Vec::with_capacity(blocks.corners.len());
    let mut fresh = blocks.is_corner.clone();
    let mut stack = Vec::new();
    for root in &blocks.corners {
        if !std::mem::take(&mut fresh[*root]) {
            continue;
        }
        stack.push((*root, None));
        while let Some((block, arrival)) = stack.last().copied() {
            let open = |side: &usize| fresh[lattice.beside(block, *side)];
            let count = (0..SIDES).filter(open).count() as u32;
            if count == 0 {
                stack.pop();
                continue;
            }
            let straight = arrival.filter(open).filter(|_| rng.random::<f64>() < straightness);
            let side = straight.unwrap_or_else(|| {
                let chosen = rng.random_range(0..count) as usize;
                (0..SIDES).filter(open).nth(chosen).expect("one of the open sides")
            });
            let to = lattice.beside(block, side);
            fresh[to] = false;
            tree.push((block, side));
            stack.push((to, Some(side)));
        }
    }
    tree
}

/// Returns the edges (block, side) of a spanning tree in every connected part of the blocks, by Wilson's algorithm:
/// every tree is equally likely.
fn wilson(lattice: &Lattice, blocks: &Blocks, rng: &mut ChaCha8Rng) -> Vec<(usize, usize)> {
    let mut tree = Vec::with_capacity(blocks.corners.len());
    let mut in_tree = vec![false; blocks.is_corner.len()];
    let mut exit = vec![0_u8; blocks.is_corner.len()];
    let rooted = roots(lattice, blocks);
    rooted.iter().for_each(|root| in_tree[*root] = true);
    for start in &blocks.corners {
        // Walk to the tree; the last exit of every block forgets the loops.
        let mut block = *start;
        while !in_tree[block] {
            let side = rng.random_range(0..SIDES as u32) as usize;
            let to = lattice.beside(block, side);
            if blocks.is_corner[to] {
                exit[block] = side as u8;
                block = to;
            }
        }
        block = *start;
        while !in_tree[block] {
            in_tree[block] = true;
            tree.push((block, exit[block] as usize));
            block = lattice.beside(block, exit[block] as usize);
        }
    }
    tree
}

/// Returns the first block of every connected part of the blocks.
fn roots(lattice: &Lattice, blocks: &Blocks) -> Vec<usize> {
    let mut fresh = blocks.is_corner.clone();
    let mut roots = Vec::new();
    let mut open = Vec::new();
    for root in &blocks.corners {
        if !std::mem::take(&mut fresh[*root]) {
            continue;
        }
        roots.push(*root);
        open.push(*root);
        while let Some(block) = open.pop() {
            for to in (0..SIDES).map(|side| lattice.beside(block, side)) {
                if std::mem::take(&mut fresh[to]) {
                    open.push(to);
                }
            }
        }
    }
    roots
}

/// Value of `next` for a cell that no loop passes.
const NONE: u32 = u32::MAX;

/// Closed loops of steps between neighbouring cells, each cell in at most one.
struct Loops<'a> {
    lattice: &'a Lattice,
    /// The cell after a cell, [`NONE`] for a cell that no loop passes.
    next: Vec<u32>,
}

impl<'a> Loops<'a> {
    /// Makes one loop of four cells, counter-clockwise, for every block.
    fn around(lattice: &'a Lattice, blocks: &Blocks) -> Self {
        let mut loops = Self { lattice, next: vec![NONE; lattice.inside.len()] };
        for block in &blocks.corners {
            for side in 0..SIDES {
                let next = lattice.side_of(*block, (side + 1) % SIDES);
                loops.link(lattice.side_of(*block, side), next);
            }
        }
        loops
    }

    fn link(&mut self, from: usize, to: usize) {
        self.next[from] = to as u32;
    }

    /// Returns the two cells on the right of the step a -> b that begins at `a`: the one beside `a`, then the one
    /// beside b.
    fn on_the_right(&self, a: usize) -> [usize; 2] {
        let b = self.next[a] as usize;
        let w = self.lattice.width as isize;
        // East: south. North: east. West: north. South: west.
        let right = match b as isize - a as isize {
            1 => -w,
            -1 => w,
            d => d.signum(),
        };
        [a, b].map(|k| k.wrapping_add_signed(right))
    }

    /// Joins two loops: the step a -> b that begins at `a` and the facing, antiparallel step c -> d become a -> d and c
    /// -> b.
    fn join(&mut self, a: usize) {
        let b = self.next[a] as usize;
        let [d, c] = self.on_the_right(a);
        debug_assert_eq!(self.next[c], d as u32, "the steps face each other");
        self.link(a, d);
        self.link(c, b);
    }

    /// Adds cells that no loop passes to the loops, two neighbouring ones at a time, where `allowed` returns true for
    /// them.
    fn absorb(&mut self, allowed: impl Fn(usize, usize) -> bool) {
        let mut queue: VecDeque<usize> =
            (0..self.next.len()).filter(|k| self.next[*k] != NONE).collect();
        while let Some(a) = queue.pop_front() {
            let b = self.next[a] as usize;
            let [s, q] = self.on_the_right(a);
            let are_free = [s, q].iter().all(|k| self.lattice.inside[*k] && self.next[*k] == NONE);
            if are_free && allowed(s, q) {
                // a -> s -> q -> b
                self.link(a, s);
                self.link(s, q);
                self.link(q, b);
                queue.extend([a, s, q]);
            }
        }
    }

    /// Joins different loops wherever two of their steps face each other.
    fn join_the_facing(&mut self) {
        let mut tour_of_cell = vec![NONE; self.next.len()];
        let tours = self.tours();
        for (i, tour) in tours.iter().enumerate() {
            tour.iter().for_each(|k| tour_of_cell[*k] = i as u32);
        }
        // Each loop points to one that it was joined to; the last in the chain is the whole.
        let mut whole: Vec<usize> = (0..tours.len()).collect();
        for a in tours.into_iter().flatten() {
            let [d, c] = self.on_the_right(a);
            if tour_of_cell[c] == NONE || self.next[c] != d as u32 {
                continue;
            }
            let [i, j] = [a, c].map(|k| last_in_chain(&mut whole, tour_of_cell[k] as usize));
            if i != j {
                self.join(a);
                whole[i] = j;
            }
        }
    }

    /// Returns the cells of every loop in the order of the path; each loop starts at its cell of smallest index.
    fn tours(&self) -> Vec<Vec<usize>> {
        let mut seen = vec![false; self.next.len()];
        let mut tours = Vec::new();
        for first in 0..self.next.len() {
            if self.next[first] == NONE || seen[first] {
                continue;
            }
            let mut tour = Vec::new();
            let mut k = first;
            while !std::mem::replace(&mut seen[k], true) {
                tour.push(k);
                k = self.next[k] as usize;
            }
            tours.push(tour);
        }
        tours
    }
}

/// Returns the root of the tree of joined loops that `i` belongs to (union-find), and shortens the path to it.
fn last_in_chain(whole: &mut [usize], mut i: usize) -> usize {
    while whole[i] != i {
        whole[i] = whole[whole[i]];
        i = whole[i];
    }
    i
}

/// Returns the path along all loops, with lifts between them; `None` if it has more than [`MAX_SEGMENTS`] segments.
fn walk(lattice: &Lattice, tours: &[Vec<usize>], settings: &MazeSettings) -> Option<Draft> {
    let step = settings.step_mm.min(settings.pitch_mm);
    let mut path = Draft::default();
    for (i, tour) in tours.iter().enumerate() {
        let mut corners: Vec<[f64; 2]> = tour.iter().map(|k| lattice.centre(*k)).collect();
        if let Some(end) = path.point_mm.last() {
            // Begin where the tool is nearest.
            let distance = |p: &[f64; 2]| (p[0] - end[0]).hypot(p[1] - end[1]);
            let nearest = (0..corners.len())
                .min_by(|a, b| distance(&corners[*a]).total_cmp(&distance(&corners[*b])));
            corners.rotate_left(nearest.unwrap_or(0));
        }
        let rounded = settings.corner_radius_mm > 0.0;
        if !settings.open {
            if rounded {
                // The first cell is a corner too: begin and end between it and the second one.
                let (a, b) = (corners[0], corners[1]);
                let middle = [0, 1].map(|k| 0.5 * (a[k] + b[k]));
                corners.rotate_left(1);
                corners.insert(0, middle);
                corners.push(middle);
            } else {
                corners.push(corners[0]);
            }
        }
        if path.point_mm.is_empty() {
            path.begin(corners[0]);
        } else {
            path.to(corners[0], false, i - 1);
        }
        if rounded {
            let pieces = pieces(&corners, settings.corner_radius_mm);
            follow(&mut path, &pieces, step, i)?;
        } else {
            for w in corners.windows(2) {
                let n = parts(settings.pitch_mm, step, path.tool_on.len())?;
                for k in 1..n {
                    let f = k as f64 / n as f64;
                    path.to([0, 1].map(|a| w[0][a] + f * (w[1][a] - w[0][a])), true, i);
                }
                path.to(w[1], true, i);
            }
        }
    }
    Some(path)
}

/// Part of a path with rounded corners: a straight line or a quarter circle, mm.
enum PathPiece {
    Line {
        from: [f64; 2],
        to: [f64; 2],
    },
    /// Quarter circle `centre + cos(phi) begin + sin(phi) end`, phi = 0 .. 90 degrees.
    Arc {
        centre: [f64; 2],
        begin: [f64; 2],
        end: [f64; 2],
    },
}

impl PathPiece {
    fn length_mm(&self) -> f64 {
        match self {
            Self::Line { from, to } => (to[0] - from[0]).hypot(to[1] - from[1]),
            Self::Arc { begin, .. } => FRAC_PI_2 * begin[0].hypot(begin[1]),
        }
    }

    /// Returns the point at the fraction `f` of the length, 0 to 1.
    fn point(&self, f: f64) -> [f64; 2] {
        match self {
            Self::Line { from, to } => [0, 1].map(|a| from[a] + f * (to[a] - from[a])),
            Self::Arc { centre, begin, end } => {
                let (sin, cos) = (FRAC_PI_2 * f).sin_cos();
                [0, 1].map(|a| centre[a] + cos * begin[a] + sin * end[a])
            }
        }
    }
}

/// Returns the path through `corners`, mm (all straight or at a right angle), with quarter circles of the radius
/// `radius_mm`.
fn pieces(corners: &[[f64; 2]], radius_mm: f64) -> Vec<PathPiece> {
    let r = radius_mm;
    let mut pieces = Vec::with_capacity(2 * corners.len());
    let mut from = corners[0];
    for w in corners.windows(3) {
        let [u, v] = [(w[0], w[1]), (w[1], w[2])].map(|(a, b)| {
            let length = (b[0] - a[0]).hypot(b[1] - a[1]);
            [(b[0] - a[0]) / length, (b[1] - a[1]) / length]
        });
        // Straight on: a right angle has u.v = 0.
        if u[0] * v[0] + u[1] * v[1] > 0.5 {
            continue;
        }
        // From B - R u to B + R v about B - R u + R v.
        let along = |f: f64, g: f64| [0, 1].map(|a| w[1][a] + r * (f * u[a] + g * v[a]));
        pieces.push(PathPiece::Line { from, to: along(-1.0, 0.0) });
        let begin = v.map(|c| -r * c);
        let end = u.map(|c| r * c);
        pieces.push(PathPiece::Arc { centre: along(-1.0, 1.0), begin, end });
        from = along(0.0, 1.0);
    }
    pieces.push(PathPiece::Line { from, to: corners[corners.len() - 1] });
    pieces
}

/// Adds nodes at equal arc length, at most `step_mm` apart, along the pieces to `path`, in the pass with the number
/// `pass`. Returns `None` if the path would have more than [`MAX_SEGMENTS`] segments.
fn follow(path: &mut Draft, pieces: &[PathPiece], step_mm: f64, pass: usize) -> Option<()> {
    let total: f64 = pieces.iter().map(PathPiece::length_mm).sum();
    // L / ceil(L/s)
    let n = parts(total, step_mm, path.tool_on.len())?;
    let mut k = 1;
    let mut before = 0.0;
    for piece in pieces {
        let length = piece.length_mm();
        while k < n && (k as f64 / n as f64) * total <= before + length {
            let f = ((k as f64 / n as f64) * total - before) / length;
            path.to(piece.point(f.clamp(0.0, 1.0)), true, pass);
            k += 1;
        }
        before += length;
    }
    if let Some(PathPiece::Line { to, .. }) = pieces.last() {
        path.to(*to, true, pass);
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::statistics;
    use ndarray::Array2;
    use planish_testkit::maps::random_aperture;
    use planish_types::{Axis, Grid};
    use proptest::prelude::*;
    use std::collections::HashSet;

    fn settings(pitch_mm: f64, overscan_mm: f64, seed: u64) -> MazeSettings {
        MazeSettings {
            pitch_mm,
            step_mm: pitch_mm,
            overscan_mm,
            corner_radius_mm: 0.0,
            tree: Tree::DepthFirst { straightness: 0.0 },
            open: false,
            seed,
        }
    }

    /// Makes a map with pixels of 0.5 mm, valid where `inside(x, y)` is true.
    fn map(nx: usize, ny: usize, inside: impl Fn(f64, f64) -> bool) -> Surface {
        let grid =
            Grid { x: Axis::new(0.0, 0.5, nx).unwrap(), y: Axis::new(0.0, 0.5, ny).unwrap() };
        let height = Array2::from_shape_fn((ny, nx), |(r, c)| {
            if inside(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)) { 0.0 } else { f64::NAN }
        });
        Surface::new(grid, height).unwrap()
    }

    fn lifts(path: &ToolPath) -> usize {
        path.tool_on().iter().filter(|on| !**on).count()
    }

    #[test]
    fn a_rectangle_is_passed_whole_up_to_parity() {
        // Centres over 19 or 20 mm by 9.5 mm and 0.5 mm more on every side.
        for (nx, cells, left_out) in [(39, 21 * 11, 1), (41, 22 * 11, 0)] {
            for tree in [Tree::DepthFirst { straightness: 0.5 }, Tree::Wilson] {
                let s = MazeSettings { tree, ..settings(1.0, 0.5, 7) };
                let made = maze(&map(nx, 20, |_, _| true), &s).unwrap();
                assert_eq!((made.cells, made.cells_left_out), (cells, left_out));
                assert_eq!(made.path.len(), cells - left_out);
                assert_eq!(lifts(&made.path), 0);
            }
        }
    }

    #[test]
    fn the_smallest_maze_is_a_square_and_rounded_a_circle() {
        let surface = map(2, 2, |_, _| true);
        let made = maze(&surface, &settings(1.0, 0.0, 1)).unwrap();
        let (low, high) = (-0.25, 0.75);
        let square = [[low, low], [high, low], [high, high], [low, high], [low, low]];
        assert_eq!(made.path.point_mm(), square);

        let circle = MazeSettings { corner_radius_mm: 0.5, step_mm: 0.01, ..settings(1.0, 0.0, 1) };
        let path = maze(&surface, &circle).unwrap().path;
        for p in path.point_mm() {
            // Rounding of coordinates of up to 0.75 mm.
            assert!(((p[0] - 0.25).hypot(p[1] - 0.25) - 0.5).abs() < 1e-12, "{p:?}");
        }
        // Chords of 0.01 mm fall short of arcs by the third order: 1e-4 of pi / 24 / 0.25.
        let length: f64 = (0..path.len()).map(|i| path.segment_length_mm(i)).sum();
        assert!((length - std::f64::consts::PI).abs() < 6e-5, "{length}");
        assert_eq!(path.len(), 315);
        // Counter-clockwise, the inside on the left.
        assert!(path.displacement_mm(0)[0] > 0.0);
    }

    #[test]
    fn an_annulus_is_one_loop_around_its_hole() {
        let annulus = |x: f64, y: f64| (8.0..=20.0).contains(&(x - 20.0).hypot(y - 20.0));
        for seed in 0..10 {
            let made = maze(&map(81, 81, annulus), &settings(1.0, 0.0, seed)).unwrap();
            assert_eq!(lifts(&made.path), 0);
            // No step over the hole.
            let hole = made.path.point_mm().iter().any(|p| (p[0] - 20.0).hypot(p[1] - 20.0) < 7.0);
            assert!(!hole);
            // At the rim only: 4 % of about 1056.
            assert!(made.cells_left_out < 45, "{} of {}", made.cells_left_out, made.cells);
        }
    }

    #[test]
    fn islands_are_passes_with_one_lift_between_them() {
        let islands = |x: f64, _: f64| !(5.0..=12.0).contains(&x);
        for corner_radius_mm in [0.0, 0.4] {
            let s = MazeSettings { corner_radius_mm, ..settings(1.0, 1.0, 3) };
            let surface = map(41, 21, islands);
            let path = maze(&surface, &s).unwrap().path;
            let lift = path.tool_on().iter().position(|on| !on).unwrap();
            assert_eq!((lifts(&path), path.pass_idx()[lift], path.pass_idx()[lift + 1]), (1, 0, 1));
            // Each comes back to where it began, the second one near the first.
            let p = path.point_mm();
            assert_eq!((p[0], p[lift + 1]), (p[lift], p[path.len()]));
            assert!(statistics(&path, &surface).lift_length_mm < 15.0);
        }
    }

    #[test]
    fn a_neck_out_of_phase_does_not_tear_the_region_apart() {
        // Two squares of 10 x 10 cells joined by a neck of two rows: over all its positions one
        // of two is out of phase with the squares.
        for row in 1..8 {
            let low = f64::from(row);
            let neck = |x: f64, y: f64| !(10.0..20.0).contains(&x) || (y >= low && y < low + 2.0);
            let made = maze(&map(60, 20, neck), &settings(1.0, 0.0, 5)).unwrap();
            assert_eq!(lifts(&made.path), 0, "neck at {row}");
        }
    }

    #[test]
    fn straightness_makes_fewer_turns_and_wilson_more() {
        let turns = |tree| {
            let s = MazeSettings { tree, ..settings(0.25, 1.0, 11) };
            let surface = map(51, 51, |_, _| true);
            statistics(&maze(&surface, &s).unwrap().path, &surface).mean_turn_deg
        };
        let straight = |straightness| turns(Tree::DepthFirst { straightness });
        let [none, half, full] = [0.0, 0.5, 1.0].map(straight);
        let wilson = turns(Tree::Wilson);
        // Measured by an independent prototype at 26 x 103 cells: 32 and 39 degrees.
        assert!((none - 32.0).abs() < 3.0 && (wilson - 39.0).abs() < 2.0, "{none} {wilson}");
        assert!(full < half - 2.0 && half < none - 2.0, "{none} {half} {full}");
    }

    #[test]
    fn wilson_draws_every_tree_as_often() {
        // 2 x 2 blocks have 4 spanning trees (one of 4 edges left out), all equally likely;
        // depth-first from the corner draws only the two that leave out an edge at the root.
        let surface = map(5, 5, |_, _| true);
        let count = |tree: Tree| {
            let mut seen = std::collections::HashMap::new();
            for seed in 0..2000 {
                let s = MazeSettings { tree, ..settings(1.0, 0.0, seed) };
                let made = maze(&surface, &s).unwrap();
                assert_eq!(made.path.len(), 16);
                *seen.entry(format!("{:?}", made.path.point_mm())).or_insert(0) += 1;
            }
            let mut counts: Vec<i32> = seen.into_values().collect();
            counts.sort_unstable();
            counts
        };
        let wilson = count(Tree::Wilson);
        // 500 each, standard deviation 19: five of them.
        assert_eq!(wilson.len(), 4);
        assert!(wilson.iter().all(|n| (n - 500).abs() < 100), "{wilson:?}");
        assert_eq!(count(Tree::DepthFirst { straightness: 0.0 }).len(), 2);
    }

    #[test]
    fn a_large_part_is_covered() {
        // 400 x 400 mm at 0.5 mm, 6.4e5 cells; `just bench` has the time.
        let surface = map(801, 801, |_, _| true);
        for tree in [Tree::DepthFirst { straightness: 0.0 }, Tree::Wilson] {
            let made = maze(&surface, &MazeSettings { tree, ..settings(0.5, 0.0, 1) }).unwrap();
            assert_eq!(made.cells, 801 * 801 + 2 * 801 + 1);
        }
    }

    #[test]
    fn a_region_too_thin_is_refused_with_advice() {
        let surface = map(41, 21, |_, _| true);
        let message =
            |surface: &Surface, s: &MazeSettings| maze(surface, s).unwrap_err().to_string();
        // 10.5 mm with the halves of the pixels at its ends.
        let error = message(&surface, &settings(11.0, 0.0, 1));
        assert!(error.contains("no 2 x 2 cells of 11 mm fit") && error.contains("10.5"), "{error}");
        assert!(maze(&surface, &settings(11.0, 0.5, 1)).is_ok());
        // A diagonal of pixels holds a square of cells only where a pixel is in its middle.
        let diagonal = map(41, 41, |x, y| x == y);
        let error = message(&diagonal, &settings(0.73, 0.0, 1));
        assert!(error.contains("smaller pitch or a larger overscan"), "{error}");
    }

    #[test]
    fn bad_settings_are_refused_with_the_value() {
        let surface = map(21, 21, |_, _| true);
        let good = settings(1.0, 1.0, 1);
        let straight = |straightness| Tree::DepthFirst { straightness };
        let cases = [
            (MazeSettings { pitch_mm: 0.0, ..good.clone() }, "pitch_mm: is 0"),
            (MazeSettings { pitch_mm: f64::INFINITY, ..good.clone() }, "pitch_mm: is inf"),
            (MazeSettings { step_mm: -1.0, ..good.clone() }, "step_mm: is -1"),
            (MazeSettings { overscan_mm: f64::NAN, ..good.clone() }, "overscan_mm: is NaN"),
            (MazeSettings { corner_radius_mm: 0.51, ..good.clone() }, "corner_radius_mm: is 0.51"),
            (MazeSettings { tree: straight(1.1), ..good.clone() }, "straightness: is 1.1"),
            (MazeSettings { tree: straight(f64::NAN), ..good.clone() }, "straightness: is NaN"),
            (MazeSettings { pitch_mm: 1e-9, ..good.clone() }, "more than 20000000"),
            (MazeSettings { step_mm: 1e-9, ..good.clone() }, "more than 20000000"),
            (MazeSettings { overscan_mm: 1e300, ..good.clone() }, "overscan_mm: is 1e300"),
        ];
        for (settings, message) in cases {
            let error = maze(&surface, &settings).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
        }
    }

    prop_compose! {
        fn random_settings()(
            pitch_mm in 0.3..3.0_f64,
            overscan_mm in prop_oneof![Just(0.0), 0.0..3.0_f64],
            tree in prop_oneof![
                (0.0..=1.0_f64).prop_map(|straightness| Tree::DepthFirst { straightness }),
                Just(Tree::Wilson),
            ],
            open in any::<bool>(),
            seed in any::<u64>(),
        ) -> MazeSettings {
            MazeSettings { tree, open, ..settings(pitch_mm, overscan_mm, seed) }
        }
    }

    /// Returns the larger of |dx| and |dy| from a point to its nearest valid pixel, mm.
    fn out_of_the_aperture(surface: &Surface, p: [f64; 2]) -> f64 {
        let g = surface.grid();
        let valid = surface.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan());
        valid
            .map(|((r, c), _)| {
                (g.x.coordinate_mm(c) - p[0]).abs().max((g.y.coordinate_mm(r) - p[1]).abs())
            })
            .fold(f64::INFINITY, f64::min)
    }

    proptest! {
        #[test]
        fn what_holds_for_every_aperture(surface in random_aperture(2..40), settings in random_settings()) {
            let made = match maze(&surface, &settings) {
                Ok(made) => made,
                Err(ToolPathError::TooThin { .. }) => return Ok(()),
                Err(e) => panic!("{e}"),
            };
            let (path, p) = (&made.path, settings.pitch_mm);
            let (point, on, pass) = (path.point_mm(), path.tool_on(), path.pass_idx());
            let cell = |q: [f64; 2]| [0, 1].map(|a| ((q[a] - point[0][a]) / p).round() as i64);

            // Passes: each cell once, unit steps, back to the start.
            let mut visited = HashSet::new();
            let mut begin = 0;
            for i in 0..path.len() {
                let d = path.displacement_mm(i);
                let unit = (d[0].abs().max(d[1].abs()) - p).abs() < 1e-9
                    && d[0].abs().min(d[1].abs()) < 1e-9;
                prop_assert!(unit || !on[i], "{i}: {d:?}");
                prop_assert!(visited.insert(cell(point[i])) , "{i}: twice");
                let ends = i + 1 == path.len() || !on[i + 1];
                if on[i] && ends {
                    let [x, y] = [0, 1].map(|a| cell(point[i + 1])[a] - cell(point[begin])[a]);
                    if settings.open {
                        prop_assert_eq!(x.abs() + y.abs(), 1);
                        prop_assert!(visited.insert(cell(point[i + 1])));
                    } else {
                        prop_assert_eq!([x, y], [0, 0]);
                    }
                    begin = i + 2;
                    if i + 1 < path.len() {
                        prop_assert_eq!((pass[i + 1], pass[i + 2]), (pass[i], pass[i] + 1));
                        // The lift begins at a cell that was counted.
                        visited.remove(&cell(point[i + 1]));
                    }
                }
            }
            prop_assert_eq!(made.cells - made.cells_left_out, visited.len());

            // Within the aperture dilated by max(o, p/2, h/2).
            let reach = settings.overscan_mm.max(0.5 * p).max(0.25) + 1e-6;
            for q in point {
                let out = out_of_the_aperture(&surface, *q);
                prop_assert!(out <= reach, "{q:?} is {out} mm out");
            }
            // Every pixel in a cell that is passed is at most half a diagonal from its centre.
            let g = surface.grid();
            let mut served = surface.height_nm().clone();
            for ((r, c), z) in served.indexed_iter_mut() {
                if !visited.contains(&cell([g.x.coordinate_mm(c), g.y.coordinate_mm(r)])) {
                    *z = f64::NAN;
                }
            }
            if let Ok(served) = Surface::new(*g, served) {
                let covered = statistics(path, &served).coverage_mm.unwrap();
                prop_assert!(covered <= 0.5_f64.sqrt() * p + 1e-9, "{covered}");
            }
            prop_assert_eq!(statistics(path, &surface).crossings, 0);
            prop_assert_eq!(maze(&surface, &settings).unwrap(), made);
        }

        #[test]
        fn rounded_corners_keep_the_lanes_apart(
            surface in random_aperture(2..40),
            settings in random_settings(),
            radius in 0.01..=0.5_f64,
            step in 0.1..1.5_f64,
        ) {
            let p = settings.pitch_mm;
            let sharp = match maze(&surface, &settings) {
                Ok(made) => made,
                Err(_) => return Ok(()),
            };
            let rounded = MazeSettings {
                corner_radius_mm: radius * p, step_mm: step * p, ..settings
            };
            let made = maze(&surface, &rounded).unwrap();
            let s = statistics(&made.path, &surface);
            prop_assert_eq!((s.crossings, s.lifts), (0, lifts(&sharp.path)));
            prop_assert!(s.longest_step_mm <= rounded.step_mm * (1.0 + 1e-9));
            // A node on a corner is (sqrt 2 - 1) R from the sharp one.
            let cut = (2.0_f64.sqrt() - 1.0) * radius * p;
            let close = |q: &[f64; 2]| {
                let each = (0..sharp.path.len()).filter(|i| sharp.path.tool_on()[*i]);
                each.map(|i| {
                    let (a, d) = (sharp.path.point_mm()[i], sharp.path.displacement_mm(i));
                    let f = ((q[0] - a[0]) * d[0] + (q[1] - a[1]) * d[1]) / (p * p);
                    let f = f.clamp(0.0, 1.0);
                    (q[0] - a[0] - f * d[0]).hypot(q[1] - a[1] - f * d[1])
                })
                .fold(f64::INFINITY, f64::min)
            };
            for q in made.path.point_mm() {
                prop_assert!(close(q) <= cut + 1e-9, "{q:?}");
            }
            if rounded.step_mm <= radius * p {
                // A chord of one radian.
                prop_assert!(s.largest_turn_deg <= 57.3, "{}", s.largest_turn_deg);
            }
        }
    }
}
