//! The plan on the clock of the program: the same path, a little slower where the plan uses a limit fully.
//!
//! ```text
//! dt = k(s) ds            s: time of the plan,  t: time of the program,  k > 1: slower than the plan
//! p(t) = P(s)
//! p'   = P' / k
//! p''  = P'' / k^2 - P' k' / k^3
//! ```
//!
//! Rounding to counts and ticks adds acceleration, so a motion that shall keep the limits after it must leave some of
//! them unused. On cells of the plan's time, `k` is the least that leaves the margin d of every limit:
//!
//! ```text
//! k >= |P'| / ((1 - d_v) V),   k^2 >= |P''| / ((1 - d_a) A),   k^3 >= |P'''| / ((1 - d_j) J)
//! ```
//!
//! times a factor that the generator raises where a program still exceeds a limit. Between cells `k` is linear, no
//! steeper than `|P'| |k'| <= f A` with f = 0.01 (`FOR_CLOCK`), for lines at most d_a / 2. Without a limit on jerk,
//! half of what the plan leaves of A counts instead if that is more.
//!
//! Time that is added removes more. So the clock gives it back nearby, where the plan uses less than its limits: with
//! e = k - 1 > 0 where the plan is slowed down, the room r = 1 - (least k) elsewhere, and sums over the cells within a
//! distance R of the path,
//!
//! ```text
//! k_j = 1 - r_j min(1, sum_i e_i / C_i),   C_i = sum_j r_j
//! ```
//!
//! The removal then differs from the plan's by time that is moved by at most R, and the program takes the plan's time.
//!
//! What remains delays the program against the plan. The next stretch with room takes a part of the delay back or adds
//! to it, until the delay is a multiple of its unit, some ticks of 2 ms together (`ClockCells::whole_ticks`). The nodes
//! after the stretch then lie at the same times of the plan as before, so mending one place does not spoil the others.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | s, t | `plan_s`, `time_s` | s |
//! | k, clock factor | `factor` | - |
//! | P, p: position of an axis in the plan, in the program | `position` | mm or deg |
//! | V, A, J: limits of an axis on velocity, acceleration, jerk | `limit` | per s, s^2, s^3 |

use std::array::from_fn;

use planish_numerics::polynomial::{derivative, evaluate, range, shifted};
use planish_types::{AxisGrid, ControllerModel, Interpolation, MachineAxis};

use crate::plan::{AxesPlan, length_mm};

/// Fraction of the acceleration limit that the rounding of a position by one count (c / T^2 in a line of T s) may use
/// in lines at the limit, if lines of that length are allowed. Larger: slower programs. Smaller: longer lines, within
/// which the speed changes.
const ROUNDING: f64 = 2e-3;

/// Shortest lines at the limit, as a fraction of the lines that leave the plan by the chosen deviation. Larger: a
/// removal that differs more. Smaller: more lines. Chosen: 0.4 of the distance from the plan.
const SHORTEST: f64 = 0.65;

/// Limits, counts and settings by which the times of the nodes of a program are chosen.
pub(crate) struct Choice<'a, const N: usize> {
    pub axes: &'a [MachineAxis; N],
    pub grids: [AxisGrid; N],
    /// Levers of the axes, mm per mm or per degree.
    pub lever: [f64; N],
    pub tick_s: f64,
    /// Smallest and largest number of ticks of a segment.
    pub ticks: [i64; 2],
    /// Largest distance of a segment from the path of the plan, mm.
    pub deviation_mm: f64,
    pub interpolation: Interpolation,
}

/// Returns the duration of the lines where a plan is at its acceleration limits, s. It is at most that of a parabola
/// that leaves the plan by `deviation_mm`, and no longer than rounding to the counts requires. `axes`, `grids` and
/// `lever` are the limits, counts and levers of the axes.
pub(crate) fn line_at_limit_s<const N: usize>(
    axes: &[MachineAxis; N],
    grids: &[AxisGrid; N],
    lever: &[f64; N],
    deviation_mm: f64,
) -> f64 {
    let limits = axes.each_ref().map(|axis| axis.max_acceleration);
    let longest_s = (8.0 * deviation_mm / length_mm(lever, limits)).sqrt();
    // c / T^2 = ROUNDING A
    let rounded = grids.iter().zip(limits).map(|(grid, a)| (grid.count / (ROUNDING * a)).sqrt());
    longest_s.min(rounded.fold(SHORTEST * longest_s, f64::max))
}

/// Fraction of the velocity limit that stays unused. Larger: slower programs. Smaller: more rounds. Chosen: rounding
/// of positions adds 1.5 counts per segment time.
const VELOCITY_MARGIN: f64 = 1e-3;

/// Fraction of the acceleration limit that stays unused at first by cubics. Larger: more time where the plan is at its
/// limit. Smaller: more places are slowed down further in later rounds. Chosen: along the random-adaptive path, 0.02
/// instead of 0.005 leaves 1.030 instead of 1.016 times the residual of the plan on a Galil.
const ACCELERATION_MARGIN: f64 = 0.005;

/// Counts that rounding is first assumed to add to the second difference of the positions of lines. Larger: more time
/// where the plan is at its limit. Smaller: more places are slowed down in later rounds. Chosen: a line whose position
/// is rounded against the limit moves by a count.
const COUNTS_OF_LINES: f64 = 1.0;

/// Largest fraction of the acceleration limit that stays unused at first by lines. Larger: coarse counts slow the plan
/// down at once. Smaller: in later rounds. Chosen.
const MOST_MARGIN_OF_LINES: f64 = 0.2;

/// Fraction of the acceleration limit that the change of the clock factor `k` may always use. Larger: the plan is
/// slowed down for shorter, and needs more rounds. Smaller: it is slowed down for longer. Chosen.
const FOR_CLOCK: f64 = 0.01;

/// Fraction of the jerk limit that stays unused. Larger: slower programs. Smaller: more rounds. Chosen: a cubic
/// segment that spans a step of the jerk exceeds the plan's by some percent.
const JERK_MARGIN: f64 = 0.06;

/// Distance R along the path within which added time is given back, mm. Larger: more of it is given back; smaller: the
/// removal is nearer to the plan's. A tool of 5 mm FWHM does not see a time that is moved by half of it.
const GIVEN_BACK_WITHIN_MM: f64 = 2.0;

/// Smallest clock factor `k` where time is given back. Larger: less is given back. Smaller: more is given back, and the
/// velocities differ more from the plan's.
const LEAST_FACTOR: f64 = 0.8;

/// Fraction of the acceleration that the plan leaves unused which the change of the clock factor `k` may use. Larger:
/// the plan is slowed down for shorter, and its acceleration changes more within a segment. Smaller: it is slowed down
/// for longer.
const UNUSED: f64 = 0.5;

/// Smallest unit of the delay of a program against its plan, s. Larger: more of the added time is taken back in the
/// next stretch with room, farther away. Smaller: the program takes longer. Chosen: a delay of less than half of it
/// does not change the removal.
const SMALLEST_DELAY_S: f64 = 2e-3;

/// Duration of a cell, s, and largest number of cells of a plan, whose cells are longer if it needs more. Larger: a
/// coarser clock factor, or more memory. Smaller: more memory and time. Chosen: shorter than a machine can follow.
const CELL_S: f64 = 2e-3;
const MOST_CELLS: f64 = 2e6;

/// Largest slope of the clock factor `k` where the plan stands, 1/s. Larger: the clock may change more abruptly there.
/// Smaller: the program stays slow for longer. Chosen.
const STEEPEST_PER_S: f64 = 2.0;

/// Position, velocity and acceleration of the axes at an instant, mm or deg, and per s and s^2.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AxesState<const N: usize> {
    pub position: [f64; N],
    pub velocity: [f64; N],
    pub acceleration: [f64; N],
}

/// Shift of the path inwards near the ends of the travel, where the motion between two nodes would leave it. A position
/// p is moved to
///
/// ```text
/// p - e (d / L)^2      d = p - (end - L) > 0
/// ```
#[derive(Clone, Copy, Debug)]
pub(crate) struct Inwards<const N: usize> {
    pub travel: [Option<[f64; 2]>; N],
    /// Largest shift e at the lower and at the upper end of every axis, mm or deg.
    pub by: [[f64; 2]; N],
    /// Levers of the axes, mm per mm or per degree.
    pub lever: [f64; N],
}

/// Length L over which the path is moved inwards at an end of the travel, mm. Larger: more of the path is moved.
/// Smaller: more acceleration. Chosen: the tool reaches the end at a low speed, so a change of micrometres over this
/// adds little acceleration.
const INWARDS_OVER_MM: f64 = 0.5;

impl<const N: usize> Inwards<N> {
    /// Returns the largest shift e of all axes and ends, mm.
    pub fn most_mm(&self) -> f64 {
        (0..N).map(|a| self.lever[a] * self.by[a][0].max(self.by[a][1])).fold(0.0, f64::max)
    }

    /// Moves a position of the plan inwards, and adapts its velocity and acceleration.
    fn apply(&self, state: &mut AxesState<N>) {
        for axis in 0..N {
            let Some([low, high]) = self.travel[axis] else { continue };
            let length = (INWARDS_OVER_MM / self.lever[axis]).min(0.25 * (high - low));
            // Outwards is +1 at the upper end, -1 at the lower one.
            for (e, end, out) in [(self.by[axis][0], low, -1.0), (self.by[axis][1], high, 1.0)] {
                let d = out * (state.position[axis] - end) + length;
                if e > 0.0 && d > 0.0 {
                    let slope = 1.0 - 2.0 * e * d / (length * length);
                    let v = state.velocity[axis];
                    state.position[axis] -= out * e * (d / length).powi(2);
                    state.velocity[axis] = v * slope;
                    state.acceleration[axis] = state.acceleration[axis] * slope
                        - out * 2.0 * e * v * v / (length * length);
                }
            }
        }
    }
}

/// A plan on the clock of its program: the same path, slower where k > 1 (see the module).
pub(crate) struct Slowed<'a, const N: usize> {
    plan: &'a AxesPlan<'a, N>,
    inwards: Inwards<N>,
    cell_s: f64,
    /// Clock factor k at the borders of the cells, length m+1.
    factor: Vec<f64>,
    /// Time of the program at the borders of the cells, s, length m+1.
    time_s: Vec<f64>,
}

/// Cells of the time of a plan, with the clock factor k that each of them needs; m is their number.
pub(crate) struct ClockCells {
    cell_s: f64,
    /// Smallest k that keeps the margins in every cell, length m, before the factors `raised`. It is below 1 where the
    /// plan uses less than its limits, but at least [`LEAST_FACTOR`].
    need: Vec<f64>,
    /// True for the cells in which the tool removes all the time, length m.
    on: Vec<bool>,
    /// Length of the path up to the borders of the cells, mm, length m+1.
    arc_mm: Vec<f64>,
    /// Largest allowed slope of k over the time of the plan in every cell, 1/s, length m.
    steepest: Vec<f64>,
    /// Factors on `need` that the generator raises where a program exceeds a limit, length m; >= 1.
    pub raised: Vec<f64>,
    /// Longest segment that may lie in every cell, s, length m.
    pub longest_s: Vec<f64>,
    /// Unit of the delay of the program against the plan, s: after every stretch of cells whose k may be lowered, the
    /// delay is brought to a whole multiple of it.
    delay_s: f64,
}

impl ClockCells {
    /// Creates the cells of `plan` for this controller. If `follows_tool` is false, the tool is taken as always on.
    /// Lines may leave the plan by `deviation_mm`.
    pub fn new<const N: usize>(
        plan: &AxesPlan<N>,
        follows_tool: bool,
        controller: &ControllerModel,
        deviation_mm: f64,
    ) -> Self {
        let tick_s = controller.tick_s;
        let is_linear = controller.interpolation == Interpolation::Linear;
        let line_s = line_at_limit_s(plan.axes, &plan.grids, &plan.lever, deviation_mm);
        let line_s = ((line_s / tick_s).floor() * tick_s).max(controller.min_segment_s);
        let total_s = plan.total_time_s();
        let cell_s = CELL_S.max(total_s / MOST_CELLS);
        let m = (total_s / cell_s).ceil().max(1.0) as usize;
        let mut cells = Self {
            cell_s,
            need: vec![LEAST_FACTOR; m],
            on: vec![true; m],
            arc_mm: Vec::with_capacity(m + 1),
            steepest: vec![STEEPEST_PER_S; m],
            raised: vec![1.0; m],
            longest_s: vec![f64::INFINITY; m],
            delay_s: (SMALLEST_DELAY_S / tick_s).ceil().max(1.0) * tick_s,
        };
        let start_s = plan.break_time_s[0];
        for segment in plan.segments() {
            let from_s = segment.start_s - start_s;
            let first = cells.index(from_s);
            let last = cells.index(from_s + segment.duration_s);
            for i in first..=last {
                cells.on[i] &= segment.tool_on || !follows_tool;
                let begin = (i as f64 * cell_s - from_s).max(0.0).min(segment.duration_s);
                let end = ((i + 1) as f64 * cell_s - from_s).clamp(begin, segment.duration_s);
                let peaks: [[f64; 3]; N] = from_fn(|axis| {
                    let v = derivative(&shifted(&segment.coefficient[axis], begin));
                    let a = derivative(&v);
                    let peak = |c: &[f64; 4]| range(c, end - begin).peak().0;
                    [peak(&v), peak(&a), derivative(&a)[0].abs()]
                });
                for (axis, limit) in plan.axes.iter().enumerate() {
                    let [speed, acceleration, jerk] = peaks[axis];
                    let most_a = limit.max_acceleration;
                    let count = plan.grids[axis].count;
                    // The rounding of lines is that of their positions; that of cubics depends on their choice.
                    let [margin_v, margin_a] = match controller.interpolation {
                        Interpolation::Hermite => [VELOCITY_MARGIN, ACCELERATION_MARGIN],
                        Interpolation::Linear => [
                            count / (line_s * limit.max_velocity),
                            COUNTS_OF_LINES * count / (line_s * line_s * most_a),
                        ]
                        .map(|margin| margin.min(MOST_MARGIN_OF_LINES)),
                    };
                    let need = &mut cells.need[i];
                    let most_v = (1.0 - margin_v) * limit.max_velocity;
                    *need = need.max(speed / most_v);
                    *need = need.max((acceleration / ((1.0 - margin_a) * most_a)).sqrt());
                    // The acceleration of joined lines has steps.
                    let max_jerk = limit.max_jerk.filter(|_| !is_linear);
                    if let Some(most) = max_jerk {
                        *need = need.max((jerk / ((1.0 - JERK_MARGIN) * most)).cbrt());
                    }
                    let unused = (1.0 - margin_a) * most_a - acceleration;
                    // Under a limit on the jerk a change of k' is a change of the acceleration that takes time.
                    let part = if max_jerk.is_some() { 0.0 } else { UNUSED };
                    let always = if is_linear { FOR_CLOCK.min(0.5 * margin_a) } else { FOR_CLOCK };
                    let for_clock = (always * most_a).max(part * unused);
                    let steepest = for_clock / speed.max(1e-9 * most_v);
                    cells.steepest[i] = cells.steepest[i].min(steepest);
                }
            }
        }
        let mut arc_mm = 0.0;
        let mut before = at_plan(plan, 0.0).position;
        for i in 0..=m {
            let here = at_plan(plan, (i as f64 * cell_s).min(total_s)).position;
            arc_mm += plan.length_mm(minus(here, before));
            before = here;
            cells.arc_mm.push(arc_mm);
        }
        cells
    }

    /// Returns the index of the cell that contains a time of the plan, s since its start; the first or the last cell
    /// beyond its ends.
    pub fn index(&self, plan_s: f64) -> usize {
        ((plan_s / self.cell_s).max(0.0) as usize).min(self.need.len() - 1)
    }

    /// Returns the clock factor `k` at the borders of the cells, length m+1. It is at least what both cells beside a
    /// border need, and nowhere steeper than allowed.
    fn factor(&self) -> Vec<f64> {
        let m = self.need.len();
        let cells: Vec<f64> = self
            .need
            .iter()
            .zip(&self.raised)
            .map(|(need, raised)| need.max(1.0) * raised)
            .collect();
        let mut k: Vec<f64> =
            (0..=m).map(|i| cells[i.saturating_sub(1)].max(cells[i.min(m - 1)])).collect();
        self.flatten(&mut k);
        self.give_back(&mut k);
        self.flatten(&mut k);
        self.whole_ticks(&mut k);
        k
    }

    /// Returns by how much `k` may be lowered at every border, length m+1. It is 0 where the program is slower than the
    /// plan, where the generator has raised `k`, where the tool does not remove on both sides, and at both ends.
    fn rooms(&self, k: &[f64]) -> Vec<f64> {
        let m = self.need.len();
        let mut rooms = vec![0.0; m + 1];
        // The ends stay as they are: the last cell is shorter than the others.
        for b in 1..m - 1 {
            let is_free = k[b] <= 1.0 && self.raised[b - 1] == 1.0 && self.raised[b] == 1.0;
            let least = self.need[b - 1].max(self.need[b]);
            if is_free && self.is_on_beside(b) {
                rooms[b] = (k[b] - least).max(0.0);
            }
        }
        rooms
    }

    /// Returns true if the tool removes in both cells beside the border `b`.
    fn is_on_beside(&self, b: usize) -> bool {
        self.on[b - 1] && self.on[b]
    }

    /// Changes `k` in stretches where it may be lowered, until the delay after each is a multiple of its unit:
    ///
    /// ```text
    /// k_j = k_j - w_j (D - u round(D / u)) / (h sum w_j)        D = h sum (k_j - 1) up to the end of the stretch
    /// ```
    ///
    /// with the unit u of the delay, the duration h of a cell, the delay D, and weights w_j. The weights are limited by
    /// the room and by the slope that `k` may still take. A stretch that would need more than its weights stays as it
    /// is.
    fn whole_ticks(&self, k: &mut [f64]) {
        let m = self.need.len();
        if m < 4 {
            return;
        }
        let mut weight = self.rooms(k);
        let left: Vec<f64> = (0..m)
            .map(|i| (self.steepest[i] * self.cell_s - (k[i + 1] - k[i]).abs()).max(0.0))
            .collect();
        for i in 0..m {
            weight[i + 1] = weight[i + 1].min(weight[i] + left[i]);
        }
        for i in (0..m).rev() {
            weight[i] = weight[i].min(weight[i + 1] + left[i]);
        }
        let mut delay_s = 0.5 * self.cell_s * (k[0] - 1.0);
        let mut b = 1;
        while b < m {
            if weight[b] == 0.0 {
                delay_s += self.cell_s * (k[b] - 1.0);
                b += 1;
                continue;
            }
            let end = (b..m).find(|j| weight[*j] == 0.0).unwrap_or(m);
            let own: f64 = (b..end).map(|j| k[j] - 1.0).sum();
            let room: f64 = weight[b..end].iter().sum();
            delay_s += self.cell_s * own;
            let over_s = delay_s - (delay_s / self.delay_s).round() * self.delay_s;
            let part = over_s / (self.cell_s * room);
            if part.abs() <= 1.0 {
                (b..end).for_each(|j| k[j] -= part * weight[j]);
                delay_s -= over_s;
            }
            b = end;
        }
    }

    /// Raises `k` until it is nowhere steeper than allowed.
    fn flatten(&self, k: &mut [f64]) {
        let m = self.need.len();
        for i in 0..m {
            k[i + 1] = k[i + 1].max(k[i] - self.steepest[i] * self.cell_s);
        }
        for i in (0..m).rev() {
            k[i] = k[i].max(k[i + 1] - self.steepest[i] * self.cell_s);
        }
    }

    /// Lowers `k` below 1 near the cells where it is above 1, so that the added time is given back.
    fn give_back(&self, k: &mut [f64]) {
        let m = self.need.len();
        if m < 4 {
            return;
        }
        let inner = 1..m - 1;
        let mut rooms = self.rooms(k);
        // Half as steep as allowed: the part of the room that is used varies too.
        for i in 0..m {
            rooms[i + 1] = rooms[i + 1].min(rooms[i] + 0.5 * self.steepest[i] * self.cell_s);
        }
        for i in (0..m).rev() {
            rooms[i] = rooms[i].min(rooms[i + 1] + 0.5 * self.steepest[i] * self.cell_s);
        }
        let room_near = self.sums_within(&rooms);
        let mut wanted = vec![0.0; m + 1];
        for b in inner.clone() {
            if self.is_on_beside(b) && k[b] > 1.0 && room_near[b] > 1e-9 {
                wanted[b] = (k[b] - 1.0) / room_near[b];
            }
        }
        let wanted_near = self.sums_within(&wanted);
        for b in inner.filter(|b| rooms[*b] > 0.0) {
            k[b] -= rooms[b] * wanted_near[b].clamp(0.0, 1.0);
        }
    }

    /// Returns the relative time that `k` adds, root mean square over the time of the plan, of sums within
    /// [`GIVEN_BACK_WITHIN_MM`] along the path. It is about the relative error of the removal.
    pub fn uneven(&self, k: &[f64]) -> f64 {
        let added: Vec<f64> = k.iter().map(|k| k - 1.0).collect();
        let times = self.sums_within(&vec![1.0; k.len()]);
        let square: f64 =
            self.sums_within(&added).iter().zip(times).map(|(a, t)| (a / t).powi(2)).sum();
        (square / k.len() as f64).sqrt()
    }

    /// Returns, for every border (m+1), the sum of `values` over the borders within [`GIVEN_BACK_WITHIN_MM`] of it
    /// along the path.
    fn sums_within(&self, values: &[f64]) -> Vec<f64> {
        let mut before = vec![0.0];
        for v in values {
            before.push(before[before.len() - 1] + v);
        }
        let mut low = 0;
        let mut end = 0;
        let mut sums = Vec::with_capacity(self.arc_mm.len());
        for place_mm in &self.arc_mm {
            while self.arc_mm[low] < place_mm - GIVEN_BACK_WITHIN_MM {
                low += 1;
            }
            while end < values.len() && self.arc_mm[end] <= place_mm + GIVEN_BACK_WITHIN_MM {
                end += 1;
            }
            sums.push(before[end] - before[low]);
        }
        sums
    }
}

impl<'a, const N: usize> Slowed<'a, N> {
    /// Creates the plan on the clock of `cells`, with its path moved by `inwards`.
    pub fn new(plan: &'a AxesPlan<'a, N>, cells: &ClockCells, inwards: Inwards<N>) -> Self {
        let factor = cells.factor();
        let mut time_s = Vec::with_capacity(factor.len());
        let mut sum = 0.0;
        let mut lost = 0.0;
        time_s.push(0.0);
        let m = cells.need.len();
        for i in 0..m {
            let is_last = i + 1 == m;
            let length =
                if is_last { plan.total_time_s() - i as f64 * cells.cell_s } else { cells.cell_s };
            // The factors lie at the borders of whole cells.
            let end = factor[i] + (factor[i + 1] - factor[i]) * length / cells.cell_s;
            // Compensated: a plan has up to 2e6 cells, and a program that is not slowed has the plan's times.
            let add = 0.5 * (factor[i] + end) * length - lost;
            let next: f64 = sum + add;
            lost = (next - sum) - add;
            sum = next;
            time_s.push(sum);
        }
        Self { plan, inwards, cell_s: cells.cell_s, factor, time_s }
    }

    /// Returns the clock factors k at the borders of the cells.
    pub fn factors(&self) -> &[f64] {
        &self.factor
    }

    /// Returns the duration of the slower motion, s.
    pub fn total_s(&self) -> f64 {
        self.time_s[self.time_s.len() - 1]
    }

    /// Returns the time of the plan, s, at a time of the program, and the clock factor k with its slope k' there.
    pub fn plan_time(&self, time_s: f64) -> (f64, f64, f64) {
        let i = self.time_s.partition_point(|t| *t <= time_s).clamp(1, self.factor.len() - 1) - 1;
        let dt = (time_s - self.time_s[i]).max(0.0);
        let k = self.factor[i];
        let slope = (self.factor[i + 1] - self.factor[i]) / self.cell_s;
        // t = k u + k' u^2 / 2
        let u = 2.0 * dt / (k + (k * k + 2.0 * slope * dt).max(0.0).sqrt());
        let plan_s = (i as f64 * self.cell_s + u).min(self.plan.total_time_s());
        (plan_s, k + slope * u, slope)
    }

    /// Returns the time of the program, s, at a time of the plan.
    pub fn program_time(&self, plan_s: f64) -> f64 {
        let i = ((plan_s / self.cell_s).max(0.0) as usize).min(self.factor.len() - 2);
        let u = plan_s - i as f64 * self.cell_s;
        let slope = (self.factor[i + 1] - self.factor[i]) / self.cell_s;
        self.time_s[i] + self.factor[i] * u + 0.5 * slope * u * u
    }

    /// Returns position, velocity and acceleration at a time of the program; beyond its end the axes rest.
    pub fn state(&self, time_s: f64) -> AxesState<N> {
        let (plan_s, k, slope) = self.plan_time(time_s);
        let mut state = at_plan(self.plan, plan_s);
        for axis in 0..N {
            let v = state.velocity[axis];
            state.velocity[axis] = v / k;
            state.acceleration[axis] = state.acceleration[axis] / (k * k) - v * slope / (k * k * k);
        }
        self.inwards.apply(&mut state);
        if time_s <= 0.0 || time_s >= self.total_s() {
            state.velocity = [0.0; N];
        }
        state
    }

    /// Returns the times of the program, s, at which a segment of the plan ends within the stretch from `from_s` to
    /// `to_s`.
    pub fn breaks_within(&self, from_s: f64, to_s: f64) -> impl Iterator<Item = f64> + '_ {
        let start_s = self.plan.break_time_s[0];
        let [low, high] = [from_s, to_s].map(|t| start_s + self.plan_time(t).0);
        let breaks = self.plan.break_time_s;
        let first = breaks.partition_point(|b| *b <= low);
        let end = breaks.partition_point(|b| *b < high).max(first);
        breaks[first..end].iter().map(move |b| self.program_time(b - start_s))
    }

    /// Returns two distances of `position` from the motion, mm: the shortest one near the program's time, and the one
    /// at this time. The shortest is looked for at the time where the velocity brings the plan nearest.
    pub fn distance_mm(&self, time_s: f64, position: [f64; N]) -> [f64; 2] {
        let here = self.state(time_s);
        let now_mm = self.plan.length_mm(minus(position, here.position));
        let Some(shift_s) = self.shift_s(&here, position) else { return [now_mm, now_mm] };
        let nearer = self.state(time_s + shift_s).position;
        [now_mm.min(self.plan.length_mm(minus(position, nearer))), now_mm]
    }

    /// Returns the time after which the state `here` comes nearest to `position` at its velocity, s; `None` if it
    /// stands or the time is [`SHIFT_S`] or more.
    fn shift_s(&self, here: &AxesState<N>, position: [f64; N]) -> Option<f64> {
        let e = minus(position, here.position);
        let v = here.velocity;
        let l = self.plan.lever;
        let along: f64 = (0..N).map(|a| l[a] * e[a] * (l[a] * v[a])).sum();
        let speed2: f64 = (0..N).map(|a| l[a] * v[a] * (l[a] * v[a])).sum();
        let shift_s = along / speed2;
        if shift_s.is_finite() && shift_s.abs() < SHIFT_S { Some(shift_s) } else { None }
    }
}

impl<const N: usize> Slowed<'_, N> {
    /// Returns an upper bound of the distance of the cubic `c`, from `start_s` over `time_s` of the program, from the
    /// path of the plan, mm. A bound below `worth_mm` is not made tighter.
    ///
    /// Any function s(u) from the time of the cubic to that of the plan gives a bound: the largest |c(u) - P(s(u))|.
    /// Piecewise linear functions that meet the nearest point at their ends leave a cubic per axis between two breaks
    /// of the plan. Its exact extremes along the line between the ends and across it are the bound. A stretch is halved
    /// until the bound is close to a distance that is reached.
    pub fn bound_mm(&self, start_s: f64, time_s: f64, c: &[[f64; 4]; N], worth_mm: f64) -> f64 {
        let ends = [0.0, time_s].map(|u| (u, self.nearest_plan_s(start_s + u, position(c, u))));
        self.bound_between(start_s, c, ends, worth_mm, MOST_HALVINGS)
    }

    /// Returns the bound between two pairs of times (u, s), of the cubic and of the plan, mm, after up to `halvings`
    /// halvings. `start_s` is the time of the program at which the cubic `c` begins. A bound below `worth_mm` is not
    /// made tighter.
    fn bound_between(
        &self,
        start_s: f64,
        c: &[[f64; 4]; N],
        [from, to]: [(f64, f64); 2],
        worth_mm: f64,
        halvings: usize,
    ) -> f64 {
        let bound = self.bound_of_linear(c, from, to);
        if bound <= worth_mm || halvings == 0 {
            return bound;
        }
        let u = 0.5 * (from.0 + to.0);
        let middle = (u, self.nearest_plan_s(start_s + u, position(c, u)));
        let reached = [from, middle, to].into_iter().fold(0.0_f64, |most, (u, s)| {
            let off = minus(position(c, u), at_plan(self.plan, s).position);
            most.max(self.plan.length_mm(off))
        });
        if bound <= TIGHT * reached {
            return bound;
        }
        let [first, second] = [[from, middle], [middle, to]]
            .map(|ends| self.bound_between(start_s, c, ends, worth_mm, halvings - 1));
        first.max(second)
    }

    /// Returns the time of the plan, s, at which it is nearest to `position`, near the time `time_s` of the program.
    pub fn nearest_plan_s(&self, time_s: f64, position: [f64; N]) -> f64 {
        let plan_s = self.plan_time(time_s.max(0.0)).0;
        let here = at_plan(self.plan, plan_s);
        let Some(shift_s) = self.shift_s(&here, position) else { return plan_s };
        let shifted_s = (plan_s + shift_s).clamp(0.0, self.plan.total_time_s());
        let there = at_plan(self.plan, shifted_s);
        let [there_mm, here_mm] =
            [there, here].map(|state| self.plan.length_mm(minus(position, state.position)));
        if there_mm < here_mm { shifted_s } else { plan_s }
    }

    /// Returns an upper bound of |c(u) - P(s(u))|, mm, with s linear between two pairs (u, s), from the extremes along
    /// and across.
    fn bound_of_linear(&self, c: &[[f64; 4]; N], from: (f64, f64), to: (f64, f64)) -> f64 {
        let plan_start_s = self.plan.break_time_s[0];
        let lever = &self.plan.lever;
        let rate = (to.1 - from.1).max(0.0) / (to.0 - from.0);
        let p = position(c, from.0);
        let q = position(c, to.0);
        let length = length_mm(lever, minus(q, p));
        let direction: [f64; N] = if length > 0.0 {
            from_fn(|a| lever[a] * (q[a] - p[a]) / length)
        } else {
            from_fn(|a| f64::from(u8::from(a == 0)))
        };
        let breaks = self.plan.break_time_s;
        let mut most = 0.0_f64;
        let mut u = from.0;
        let mut time_s = plan_start_s + from.1;
        let mut i = breaks.partition_point(|b| *b <= time_s).clamp(1, self.plan.len()) - 1;
        loop {
            let segment = self.plan.segment(i);
            let rest_s = breaks[i + 1] - time_s;
            // The rest of this segment, or of the stretch.
            let is_last = rate * (to.0 - u) <= rest_s || i + 1 == self.plan.len();
            let du = if is_last { to.0 - u } else { rest_s / rate };
            let off: [[f64; 4]; N] = from_fn(|a| {
                let local_s = (time_s - segment.start_s).clamp(0.0, segment.duration_s);
                let plan = shifted(&segment.coefficient[a], local_s);
                let own = shifted(&c[a], u);
                let mut scale = 1.0;
                [0, 1, 2, 3].map(|k| {
                    let d = own[k] - scale * plan[k];
                    scale *= rate;
                    lever[a] * d
                })
            });
            most = most.max(largest_of(&off, &direction, du.max(0.0)));
            if is_last {
                return most;
            }
            u += du;
            time_s = breaks[i + 1];
            i += 1;
        }
    }
}

/// Returns an upper bound of the length of a vector of cubics over `time_s`, from its extremes along a direction and
/// across it. `off` are the ascending coefficients of its components, and `direction` is a unit vector.
fn largest_of<const N: usize>(off: &[[f64; 4]; N], direction: &[f64; N], time_s: f64) -> f64 {
    let peak = |c: [f64; 4]| range(&c, time_s).peak().0;
    let part = |w: [f64; N]| {
        [0, 1, 2, 3].map(|k| (1..N).fold(w[0] * off[0][k], |sum, a| sum + w[a] * off[a][k]))
    };
    let along = part(*direction);
    if N == 2 {
        // One direction is across.
        return peak(along).hypot(peak(part(from_fn(|a| [-direction[1], direction[0]][a]))));
    }
    (0..N).fold(peak(along), |sum, a| {
        let across = [0, 1, 2, 3].map(|k| off[a][k] - direction[a] * along[k]);
        sum.hypot(peak(across))
    })
}

/// Returns the difference p - q of two positions.
fn minus<const N: usize>(p: [f64; N], q: [f64; N]) -> [f64; N] {
    from_fn(|a| p[a] - q[a])
}

/// Returns the positions of the cubics `c` of all axes at the time `u` since their start.
pub(crate) fn position<const N: usize>(c: &[[f64; 4]; N], u: f64) -> [f64; N] {
    c.each_ref().map(|c| evaluate(c, u))
}

/// Largest number of halvings of a stretch for the bound; each leaves a quarter of the error of the linear map of the
/// times. Larger: more time. Smaller: a looser bound.
const MOST_HALVINGS: usize = 8;

/// Ratio of the bound to a distance that is reached below which the bound is good enough. Larger: a looser bound.
/// Smaller: more halvings.
const TIGHT: f64 = 1.05;

/// Largest shift in time within which the nearest point of the plan is searched, s.
const SHIFT_S: f64 = 0.01;

/// Returns position, velocity and acceleration of the plan at a time since its start, s.
pub(crate) fn at_plan<const N: usize>(plan: &AxesPlan<N>, plan_s: f64) -> AxesState<N> {
    let time_s = plan.break_time_s[0] + plan_s;
    let i = plan.break_time_s.partition_point(|b| *b <= time_s).clamp(1, plan.len()) - 1;
    let segment = plan.segment(i);
    let u = (time_s - segment.start_s).clamp(0.0, segment.duration_s);
    let first = segment.coefficient.each_ref().map(derivative);
    let second = first.each_ref().map(derivative);
    AxesState {
        position: position(segment.coefficient, u),
        velocity: position(&first, u),
        acceleration: position(&second, u),
    }
}
