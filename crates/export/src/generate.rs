//! Nodes of a program from a plan: on the clock of the controller, in its counts, within the limits of the machine. The
//! plan is the motion that the program shall execute. A node is an end of a segment of the program; a tick is the unit
//! of its clock.
//!
//! 1. The plan gets its clock (`slowed`): its own, slower only where it uses a limit fully.
//! 2. `nodes` chooses the times of the nodes, multiples of the tick, and the plan is sampled there.
//! 3. Positions are rounded to counts.
//! 4. `velocities` finds the velocities of the nodes, multiples of their unit, with times and positions fixed.
//! 5. The motion that the controller executes is proven within the limits and the travel, on the whole of every
//!    segment, and compared with the plan. Where it is not, the plan is slowed down a little more there, and all of it
//!    is done again.
//!
//! A controller that only knows straight lines (`linear`) joins them. Around the node between two lines the motion is
//! then a parabola over half the shorter line on both sides, which the planner of a controller that blends can run:
//!
//! ```text
//! a_k = (m_k - m_{k-1}) / b_k,   b_k = min(T_{k-1}, T_k)      m_k = dp_k / T_k; before and after the motion m = 0
//! ```
//!
//! Here a_k is the acceleration around node k, b_k the duration of the parabola, T_k the duration and dp_k the distance
//! of line k, which follows node k. So the executed motion of joined lines begins half a line before the first node and
//! ends half a line after the last. A dwell (G4) begins when the motion before it has ended, so the parabolas beside it
//! take their halves of its time.

use std::array::from_fn;

use planish_numerics::polynomial::{derivative, evaluate, range};
use planish_types::{
    AxisGrid, ControllerModel, Interpolation, Invalid, MachineAxis, budget::affordable,
};

use crate::{
    lines::AxisCounts,
    nodes,
    plan::AxesPlan,
    slowed::{Choice, ClockCells, Inwards, Slowed, at_plan, position},
    velocities::{Axis, hermite},
};

/// Largest whole number up to which a float holds every whole number, 2^53. Derived: larger numbers of counts or ticks
/// would be wrong.
const LARGEST_EXACT_INTEGER: f64 = 9_007_199_254_740_992.0;

/// Smallest count (unit of position of an axis), mm or deg; a smaller one is refused. Larger: fine encoders are
/// refused. Smaller: positions that the nine decimals of a program cannot distinguish.
const SMALLEST_COUNT: f64 = 1e-9;

/// Memory that one segment needs, bytes, for the check of the memory budget. Larger: programs are refused that fit.
/// Smaller: the memory may run out. Derived: nodes as floats and as counts, programs, and two lines of text of up to 60
/// bytes.
const BYTES_PER_SEGMENT: usize = 1024;

/// Largest number of rounds of the generator; each lengthens the segments that exceed a limit. Larger: more time before
/// a plan is refused. Smaller: plans are refused that could be mended. Chosen: 3 to 15 rounds are usual.
const MOST_ROUNDS: usize = 80;

/// Excess of a limit, as a fraction of it, that counts as rounding of the arithmetic. Larger: a program may exceed a
/// limit by it. Smaller: rounding is mended in further rounds. Chosen: that of `planish verify`.
const LIMIT_ROUNDING: f64 = 1e-9;

/// Smallest excess of the travel, as a fraction of the path deviation, that is mended by shorter segments, which follow
/// the plan more closely. A smaller excess is mended by moving the path inwards. Larger: the path moves farther.
/// Smaller: more segments. Chosen.
const FAR_BEYOND: f64 = 0.2;

/// Factor on the length of a segment in the next round if it leaves the path by too much; below 1. Larger: more rounds.
/// Smaller: more segments than needed. Chosen.
const LESS_LONG: f64 = 0.6;

/// Fraction of the path deviation that the choice of the nodes may use; rounding and the velocities use the rest.
/// Larger: more rounds, because the rest is too small. Smaller: more segments. Chosen.
const CHOSEN_DEVIATION: f64 = 0.6;

/// Largest factor by which a segment of a plan may be slowed down. Larger: programs that hardly move there. Smaller:
/// plans are refused. Chosen: a plan that needs more is not one for this controller.
const MOST_FACTOR: f64 = 64.0;

/// Smallest relative growth of the time of a segment that exceeds a limit, from round to round: first for cubics, then
/// for straight lines. Larger: more time is added than needed. Smaller: more rounds. Chosen: smaller for lines, because
/// they exceed a limit by rounding alone.
const LEAST_GROWTH: f64 = 2e-3;
const LEAST_GROWTH_OF_LINES: f64 = 2e-4;

/// Largest distance by which a position of lines is moved along an axis so that rounding keeps the limits, mm. Larger:
/// positions may run away where the plan leaves no room. Smaller: more places are slowed down. Chosen: nearly all of it
/// is along the path, a time of milliseconds; the distance from the path has its own limit.
const MOST_MOVED_MM: f64 = 0.1;

/// Number of intervals of every cubic at whose ends the contact point is compared with that of the plan. Larger: more
/// time. Smaller: a deviation between the points may be missed.
const CONTACT_POINTS: usize = 7;

/// Fraction of the path deviation up to which the bound of the distance from the path is not made tighter. Larger: less
/// time. Smaller: a tighter bound that nobody needs.
const WORTH: f64 = 0.3;

/// Settings of the generator of nodes (the ends of the segments of a program).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct GeneratorSettings {
    /// Clock, counts and kind of motion between two nodes of the controller.
    pub controller: ControllerModel,
    /// Largest number of ticks of a segment.
    pub most_ticks: i64,
    /// Largest distance of the program's path from the plan's, mm.
    pub path_deviation_mm: f64,
    /// True if the program switches the tool as the plan does; false if the tool stays on.
    pub follows_tool: bool,
}

/// Nodes of a program, in ticks and counts of a controller; n is the number of segments.
#[derive(Clone, Debug)]
pub(crate) struct Nodes<const N: usize> {
    /// Size of a count (unit of position of the controller) of every axis, mm or deg.
    pub count: [f64; N],
    /// Duration of a tick (unit of the clock of the program), s.
    pub tick_s: f64,
    /// Ticks from the start to every node, length n+1.
    pub ticks: Vec<i64>,
    /// Absolute position of every axis at every node in counts, length n+1.
    pub counts: Vec<[i64; N]>,
    /// Velocity of every axis at every node, mm/s or deg/s, length n+1. It is a multiple of the resolution of the
    /// controller; zero for lines.
    pub velocity: Vec<[f64; N]>,
    /// True for the segments in which the tool removes, length n.
    pub tool_on: Vec<bool>,
    /// Kind of motion between two nodes: cubics or joined lines.
    pub interpolation: Interpolation,
    /// Largest distance of the executed path from the plan's, mm.
    pub deviation_mm: f64,
    /// Largest distance of the executed contact point from that of the plan, mm; `None` if the plan does not know it.
    pub contact_mm: Option<f64>,
    /// Difference between the time of the program and that of the plan, s; positive if the program takes longer.
    pub added_s: f64,
    /// Relative change of the dwell times of the plan by the slower clock, root mean square, as a fraction (see
    /// [`ClockCells::uneven`]).
    pub uneven: f64,
}

impl<const N: usize> Nodes<N> {
    /// Returns the position of every axis at node `k`, mm or deg.
    pub fn position(&self, k: usize) -> [f64; N] {
        from_fn(|a| self.counts[k][a] as f64 * self.count[a])
    }

    /// Returns the time of node `k` since the start, s.
    pub fn time_s(&self, k: usize) -> f64 {
        self.ticks[k] as f64 * self.tick_s
    }

    /// Returns the signed distance of every axis in segment `k`, in counts.
    pub fn distance(&self, k: usize) -> [i64; N] {
        from_fn(|a| self.counts[k + 1][a] - self.counts[k][a])
    }

    /// Returns the duration of segment `k` in ticks.
    pub fn duration(&self, k: usize) -> i64 {
        self.ticks[k + 1] - self.ticks[k]
    }

    /// Returns the duration of segment `k`, s.
    fn segment_s(&self, k: usize) -> f64 {
        self.duration(k) as f64 * self.tick_s
    }

    /// Returns the number of segments n.
    pub fn segments(&self) -> usize {
        self.tool_on.len()
    }

    /// Returns true if segment `k` has no length. For lines it is a dwell, before which the motion ends.
    pub fn stands(&self, k: usize) -> bool {
        self.distance(k) == [0; N]
    }

    /// Returns the duration of the parabola around node `k`, s: that of the shorter line beside it; 0 between two
    /// dwells.
    fn parabola_s(&self, k: usize) -> f64 {
        let beside = k.saturating_sub(1)..(k + 1).min(self.segments());
        let lines = beside.filter(|i| !self.stands(*i)).map(|i| self.duration(i));
        lines.min().map_or(0.0, |ticks| ticks as f64 * self.tick_s)
    }

    /// Returns the time of the G4 command for the dwell `k`, s; the halves of the parabolas beside it take the rest of
    /// the segment.
    pub fn wait_s(&self, k: usize) -> f64 {
        let parabolas_s = self.parabola_s(k) + self.parabola_s(k + 1);
        (self.segment_s(k) - 0.5 * parabolas_s).max(0.0)
    }

    /// Returns the duration of the executed motion, s. That of joined lines is longer than the time from the first to
    /// the last node, because half a parabola lies outside at both ends.
    pub fn total_s(&self) -> f64 {
        let n = self.segments();
        let nodes_s = self.time_s(n) - self.time_s(0);
        if self.interpolation == Interpolation::Hermite {
            return nodes_s;
        }
        // Half a line before the first node and after the last one, and what a short dwell has too little for parabolas.
        let [first_s, last_s] = [(0, 0), (n - 1, n)].map(|(segment, node)| {
            if self.stands(segment) { 0.0 } else { 0.5 * self.parabola_s(node) }
        });
        let mut short_s = 0.0;
        for k in (0..n).filter(|k| self.stands(*k)) {
            let parabolas_s = self.parabola_s(k) + self.parabola_s(k + 1);
            short_s += (0.5 * parabolas_s - self.segment_s(k)).max(0.0);
        }
        nodes_s + first_s + last_s + short_s
    }

    /// Joins consecutive lines without length, with the same state of the tool, to one dwell of at most `most_ticks`.
    fn stand_at_once(&mut self, most_ticks: i64) {
        let mut remaining = vec![0];
        let mut tool_on: Vec<bool> = Vec::new();
        for k in 0..self.segments() {
            let is_one = k > 0
                && self.stands(k - 1)
                && self.stands(k)
                && self.tool_on[k - 1] == self.tool_on[k]
                && self.ticks[k + 1] - self.ticks[remaining[remaining.len() - 2]] <= most_ticks;
            if is_one {
                remaining.pop();
            } else {
                tool_on.push(self.tool_on[k]);
            }
            remaining.push(k + 1);
        }
        self.keep(&remaining, tool_on);
    }

    /// Removes dwells that are shorter than the parabolas beside them. Their time goes to the line before, or else to
    /// the line after. A dwell stays if a line would become longer than `most_ticks`.
    fn drop_short_dwells(&mut self, most_ticks: i64) {
        let mut remaining = vec![0];
        let mut tool_on: Vec<bool> = Vec::new();
        let mut k = 0;
        while k < self.segments() {
            let before = match remaining[..] {
                [.., from, to] if self.counts[from] != self.counts[to] => {
                    self.ticks[to] - self.ticks[from]
                }
                _ => 0,
            };
            let is_line_after = k + 1 < self.segments() && !self.stands(k + 1);
            let after = if is_line_after { self.duration(k + 1) } else { 0 };
            let own = self.duration(k);
            let is_short = self.stands(k) && 2 * own < before + after + 2;
            if is_short && before > 0 && before + own <= most_ticks {
                remaining.pop();
                remaining.push(k + 1);
                k += 1;
            } else if is_short && after > 0 && after + own <= most_ticks {
                remaining.push(k + 2);
                tool_on.push(self.tool_on[k + 1]);
                k += 2;
            } else {
                remaining.push(k + 1);
                tool_on.push(self.tool_on[k]);
                k += 1;
            }
        }
        self.keep(&remaining, tool_on);
    }

    /// Keeps only the nodes with these indices; `tool_on` is the state of the tool in the segments between them.
    fn keep(&mut self, nodes: &[usize], tool_on: Vec<bool>) {
        self.ticks = nodes.iter().map(|k| self.ticks[*k]).collect();
        self.counts = nodes.iter().map(|k| self.counts[*k]).collect();
        self.velocity = nodes.iter().map(|k| self.velocity[*k]).collect();
        self.tool_on = tool_on;
    }

    /// Returns the cubics that the controller executes, in their order in time: one per segment, or the straight pieces
    /// and half parabolas of joined lines.
    pub(crate) fn pieces(&self) -> Vec<ExecutedCubic<N>> {
        match self.interpolation {
            Interpolation::Hermite => (0..self.segments()).map(|k| self.cubic(k)).collect(),
            Interpolation::Linear => self.joined(self.segments()),
        }
    }

    /// Returns the cubics of [`Self::pieces`] for nodes from which the motion goes on: joined lines without the way to
    /// rest at the last node.
    pub(crate) fn pieces_to_last_node(&self) -> Vec<ExecutedCubic<N>> {
        match self.interpolation {
            Interpolation::Hermite => self.pieces(),
            Interpolation::Linear => self.joined(self.segments() - 1),
        }
    }

    /// Returns the cubic of segment `k`, given by the positions and velocities at its ends.
    fn cubic(&self, k: usize) -> ExecutedCubic<N> {
        let start_s = self.time_s(k);
        let time_s = self.segment_s(k);
        let from = self.position(k);
        let coefficient = from_fn(|a| {
            let distance = self.distance(k)[a] as f64 * self.count[a];
            let v = [self.velocity[k][a], self.velocity[k + 1][a]];
            let mut c = hermite(distance, v, time_s);
            c[0] = from[a];
            c
        });
        ExecutedCubic { segment: k, start_s, time_s, coefficient }
    }

    /// Returns the motion of joined lines: straight pieces, and the parabolas between them up to node `last`.
    fn joined(&self, last: usize) -> Vec<ExecutedCubic<N>> {
        let n = self.segments();
        let mean = |k: usize| -> [f64; N] {
            from_fn(|a| self.distance(k)[a] as f64 * self.count[a] / self.segment_s(k))
        };
        let at_rest = [0.0; N];
        let mut pieces = Vec::with_capacity(2 * n + 1);
        for k in 0..=last {
            let m = if k > 0 { mean(k - 1) } else { at_rest };
            let next = if k < n { mean(k) } else { at_rest };
            let node = self.position(k);
            let node_s = self.time_s(k);
            let parabola_s = self.parabola_s(k);
            let half = 0.5 * parabola_s;
            if parabola_s > 0.0 {
                // Half of it belongs to the segment before, half to the one after: the tool switches at the node.
                let a: [f64; N] = from_fn(|i| (next[i] - m[i]) / parabola_s);
                let first = from_fn(|i| [node[i] - half * m[i], m[i], 0.5 * a[i], 0.0]);
                let middle = from_fn(|i| {
                    let v = m[i] + a[i] * half;
                    [node[i] - half * m[i] + half * (m[i] + 0.5 * a[i] * half), v, 0.5 * a[i], 0.0]
                });
                pieces.push(ExecutedCubic {
                    segment: k.saturating_sub(1),
                    start_s: node_s - half,
                    time_s: half,
                    coefficient: first,
                });
                pieces.push(ExecutedCubic {
                    segment: k.min(n - 1),
                    start_s: node_s,
                    time_s: half,
                    coefficient: middle,
                });
            }
            // The straight rest of the line until the next parabola, or the dwell.
            if k < n {
                let rest_s = self.segment_s(k) - half - 0.5 * self.parabola_s(k + 1);
                if rest_s > 1e-12 {
                    let c = from_fn(|i| [node[i] + half * next[i], next[i], 0.0, 0.0]);
                    let start_s = node_s + half;
                    pieces.push(ExecutedCubic {
                        segment: k,
                        start_s,
                        time_s: rest_s,
                        coefficient: c,
                    });
                }
            }
        }
        pieces
    }
}

/// A cubic of the executed motion: its duration `time_s`, and ascending coefficients for every axis from its start.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ExecutedCubic<const N: usize> {
    /// Index of the segment of the program to which it belongs.
    pub segment: usize,
    /// Start of the cubic since the first node, s.
    pub start_s: f64,
    pub time_s: f64,
    pub coefficient: [[f64; 4]; N],
}

/// Returns the nodes of a program for `plan`, which is continuous, keeps the limits of the machine and rests at both
/// ends ([`crate::limits::check_plan`]). `settings` hold the clock, the counts and the allowed deviation.
///
/// Refuses counts, a path deviation or a shortest segment that are not possible for this plan. Also refuses a plan for
/// which no program within the limits is found, or which needs more memory than the budget.
pub(crate) fn generate<const N: usize>(
    plan: &AxesPlan<N>,
    settings: &GeneratorSettings,
) -> Result<Nodes<N>, Invalid> {
    Generator::new(plan, settings)?.run()
}

struct Generator<'a, const N: usize> {
    plan: &'a AxesPlan<'a, N>,
    settings: &'a GeneratorSettings,
    least_ticks: i64,
    inwards: Inwards<N>,
    /// Times of the plan at which the tool switches, s.
    switches_s: Vec<f64>,
}

/// Faults of a program that the next round has to mend: exceeded limits, and deviations from the path of the plan.
struct Faults<const N: usize> {
    /// Index of each segment that exceeds a limit, and the factor by which its time has to grow.
    slow: Vec<(usize, f64)>,
    /// Indices of the segments that leave the path, or the travel of an axis by far, and can be made shorter.
    long: Vec<usize>,
    /// Largest excess of the travel at the lower and the upper end of every axis, mm or deg.
    beyond: [[f64; 2]; N],
    deviation_mm: f64,
}

impl<const N: usize> Faults<N> {
    fn is_none(&self) -> bool {
        self.slow.is_empty() && self.long.is_empty() && self.beyond == [[0.0; 2]; N]
    }
}

impl<'a, const N: usize> Generator<'a, N> {
    fn new(plan: &'a AxesPlan<'a, N>, settings: &'a GeneratorSettings) -> Result<Self, Invalid> {
        let model = &settings.controller;
        check_counts(plan)?;
        if !(settings.path_deviation_mm.is_finite() && settings.path_deviation_mm > 0.0) {
            let problem = format!("is {}", settings.path_deviation_mm);
            return Err(Invalid::whole("path_deviation_mm", problem, "give a length in mm"));
        }
        let rounding_s = match model.interpolation {
            Interpolation::Hermite => least_for_rounding_s(plan).min(LONGEST_LEAST_S),
            // The deviation from the plan's path decides on the length of lines.
            Interpolation::Linear => 0.0,
        };
        let least_s = model
            .min_segment_s
            .max(plan.machine.limits().min_segment_s())
            .max(rounding_s.min(settings.most_ticks as f64 * model.tick_s));
        // A hair less is the rounding of a number that was typed.
        let least_ticks = ((least_s / model.tick_s) * (1.0 - 1e-9)).ceil().max(1.0);
        if least_ticks > settings.most_ticks as f64 {
            let problem = format!(
                "is {least_s} s, the longest segment {} s",
                settings.most_ticks as f64 * model.tick_s
            );
            let remedy = "give a longer `max_step_s`, or a smaller tick";
            return Err(Invalid::whole("min_segment_s", problem, remedy));
        }
        let half = 0.5 * settings.path_deviation_mm;
        if let Some(axis) = (0..N).find(|a| plan.lever[*a] * plan.grids[*a].count > half) {
            let count = plan.grids[axis].count;
            let mut at_lever = String::new();
            if plan.axes[axis].is_rotary {
                let mm = plan.lever[axis] * count;
                at_lever = format!(" ({mm:.6} mm at the lever of the axis)");
            }
            let problem = format!(
                "is {count}{at_lever}, more than half the path deviation of {} mm",
                settings.path_deviation_mm
            );
            let remedy = "give a smaller count or a larger `path_deviation_mm`";
            return Err(Invalid::whole(name_of_count(&plan.axes[axis]), problem, remedy));
        }
        let on = plan.tool_on;
        let start_s = plan.break_time_s[0];
        let switches = (1..plan.len()).filter(|k| settings.follows_tool && on[*k] != on[*k - 1]);
        Ok(Self {
            plan,
            settings,
            least_ticks: least_ticks as i64,
            inwards: Inwards {
                travel: from_fn(|a| plan.axes[a].travel),
                by: [[0.0; 2]; N],
                lever: plan.lever,
            },
            switches_s: switches.map(|k| plan.break_time_s[k] - start_s).collect(),
        })
    }

    /// Makes programs until one has no faults; each round mends the faults of the one before. Refuses a plan whose
    /// faults remain.
    fn run(mut self) -> Result<Nodes<N>, Invalid> {
        let controller = &self.settings.controller;
        let chosen_mm = CHOSEN_DEVIATION * self.settings.path_deviation_mm;
        let mut cells =
            ClockCells::new(self.plan, self.settings.follows_tool, controller, chosen_mm);
        let least_growth = match controller.interpolation {
            Interpolation::Hermite => LEAST_GROWTH,
            Interpolation::Linear => LEAST_GROWTH_OF_LINES,
        };
        let mut last = (0, 1.0_f64);
        let mut deviation_mm = 0.0;
        for _ in 0..MOST_ROUNDS {
            let motion = Slowed::new(self.plan, &cells, self.inwards);
            let mut nodes = self.nodes(&motion, &cells)?;
            let faults = self.finish(&motion, &mut nodes);
            nodes.deviation_mm = faults.deviation_mm;
            deviation_mm = faults.deviation_mm;
            if faults.is_none() {
                nodes.contact_mm = self.contact_mm(&motion, &nodes)?;
                return Ok(nodes);
            }
            // The others move the nodes, and with them how far the motion goes between two of them.
            let is_settled = faults.slow.is_empty() && faults.long.is_empty();
            for axis in (0..N).filter(|_| is_settled) {
                // Half a count more, because a node is a whole count.
                let count = self.plan.grids[axis].count;
                for (by, beyond) in self.inwards.by[axis].iter_mut().zip(faults.beyond[axis]) {
                    if beyond > 0.0 {
                        *by += beyond + 0.5 * count;
                    }
                }
            }
            if self.inwards.most_mm() > self.settings.path_deviation_mm {
                break;
            }
            for k in &faults.long {
                let longest_s = LESS_LONG * nodes.duration(*k) as f64 * nodes.tick_s;
                let span =
                    [*k, *k + 1].map(|node| cells.index(motion.plan_time(nodes.time_s(node)).0));
                for i in span[0]..=span[1] {
                    cells.longest_s[i] = cells.longest_s[i].min(longest_s);
                }
            }
            for (k, excess) in &faults.slow {
                last = (*k, *excess);
                // The segment and its neighbours: an excess is mended where the velocities change.
                let from = motion.plan_time(nodes.time_s(k.saturating_sub(1))).0;
                let to = motion.plan_time(nodes.time_s((k + 2).min(nodes.segments()))).0;
                let grow = 1.0 + (excess - 1.0).clamp(least_growth, 0.1);
                for i in cells.index(from)..=cells.index(to) {
                    let target = cells.raised[i] * grow;
                    cells.raised[i] = target.min(MOST_FACTOR);
                }
            }
        }
        let (k, excess) = last;
        let (problem, remedy) = if excess > 1.0 || deviation_mm > self.settings.path_deviation_mm {
            (
                format!(
                    "still asks for {:.2} times what the machine can do, or leaves the path by more than {} mm \
                     (largest now: {:.4} mm), on a clock of {} s with counts of {}",
                    excess * excess,
                    self.settings.path_deviation_mm,
                    deviation_mm,
                    self.settings.controller.tick_s,
                    self.largest_counts()
                ),
                "give a smaller tick or count, or a larger `path_deviation_mm`",
            )
        } else {
            (
                "leaves the travel of an axis between two nodes".to_string(),
                "move the part (part_origin_mm of the machine), or plan with a smaller overscan",
            )
        };
        Err(Invalid::at_index("segment", k, problem, remedy))
    }

    /// Makes the nodes of a program on the clock of `motion`; nothing proves yet that it keeps the limits. Refuses
    /// times and positions that are too large for exact counts, and more segments than fit into the memory budget.
    fn nodes(&self, motion: &Slowed<N>, cells: &ClockCells) -> Result<Nodes<N>, Invalid> {
        let model = &self.settings.controller;
        let choice = Choice {
            axes: self.plan.axes,
            grids: self.plan.grids,
            lever: self.plan.lever,
            tick_s: model.tick_s,
            ticks: [self.least_ticks, self.settings.most_ticks],
            deviation_mm: CHOSEN_DEVIATION * self.settings.path_deviation_mm,
            interpolation: model.interpolation,
        };
        let end = motion.total_s() / model.tick_s;
        if end.is_nan() || end >= LARGEST_EXACT_INTEGER {
            let problem = format!("is {} s, {end:e} ticks", motion.total_s());
            return Err(Invalid::whole("time_s", problem, "give a larger tick"));
        }
        // As long as the plan but for the rounding of its times.
        let end = (end - 1e-6).ceil().max(1.0) as i64;
        let mut fixed: Vec<i64> = Vec::with_capacity(self.switches_s.len() + 1);
        let far_enough = |fixed: &[i64], tick: i64| {
            tick.max(fixed.last().copied().unwrap_or(0) + self.least_ticks)
        };
        for s in &self.switches_s {
            let tick = (motion.program_time(*s) / model.tick_s).round() as i64;
            fixed.push(far_enough(&fixed, tick));
        }
        fixed.push(far_enough(&fixed, end));
        let at_least = fixed[fixed.len() - 1] as f64 / self.settings.most_ticks as f64;
        affordable(
            "program segments",
            at_least,
            BYTES_PER_SEGMENT,
            "give a longer `max_step_s`, or a larger tick",
        )?;
        let ticks = nodes::choose(motion, cells, &fixed, &choice);
        let n = ticks.len() - 1;
        let states: Vec<_> = ticks.iter().map(|t| motion.state(*t as f64 * model.tick_s)).collect();
        let mut counts = Vec::with_capacity(n + 1);
        for (k, state) in states.iter().enumerate() {
            let mut of_node = [0; N];
            for (axis, count) in of_node.iter_mut().enumerate() {
                *count = self.count(k, axis, state.position[axis])?;
            }
            counts.push(of_node);
        }
        if model.interpolation == Interpolation::Linear {
            self.keep_limits(&ticks, &mut counts);
        }
        let on = self.tool_states(&fixed, &ticks[..n]);
        let mut nodes = Nodes {
            count: self.plan.grids.map(|grid| grid.count),
            tick_s: model.tick_s,
            ticks,
            counts,
            velocity: states.iter().map(|s| s.velocity).collect(),
            tool_on: on,
            interpolation: model.interpolation,
            deviation_mm: 0.0,
            contact_mm: None,
            added_s: 0.0,
            uneven: cells.uneven(motion.factors()),
        };
        if model.interpolation == Interpolation::Linear {
            nodes.stand_at_once(self.settings.most_ticks);
            nodes.drop_short_dwells(self.settings.most_ticks);
        }
        let n = nodes.segments();
        nodes.added_s = nodes.total_s() - self.plan.total_time_s();
        nodes.velocity[0] = [0.0; N];
        nodes.velocity[n] = [0.0; N];
        Ok(nodes)
    }

    /// Returns the state of the tool in the segment that begins at each of `ticks`, true for on. The plan switches the
    /// tool at the ticks `fixed`; if the program does not follow it, the tool is on in all segments.
    fn tool_states(&self, fixed: &[i64], ticks: &[i64]) -> Vec<bool> {
        let mut on = Vec::with_capacity(ticks.len());
        let mut state = self.plan.tool_on[0];
        let mut next = 0;
        for tick in ticks {
            while next < self.switches_s.len() && fixed[next] <= *tick {
                state = !state;
                next += 1;
            }
            on.push(state || !self.settings.follows_tool);
        }
        on
    }

    /// Moves the positions of lines, `counts`, where rounding would exceed a limit.
    fn keep_limits(&self, ticks: &[i64], counts: &mut [[i64; N]]) {
        let tick_s = self.settings.controller.tick_s;
        let time_s: Vec<f64> = ticks.windows(2).map(|t| (t[1] - t[0]) as f64 * tick_s).collect();
        for (axis, limits) in self.plan.axes.iter().enumerate() {
            let count = self.plan.grids[axis].count;
            let axis_counts = AxisCounts {
                time_s: &time_s,
                velocity: limits.max_velocity / count,
                acceleration: limits.max_acceleration / count,
                travel: self.travel_counts(axis),
                most_moved: (MOST_MOVED_MM / (self.plan.lever[axis] * count)) as i64,
            };
            let mut positions: Vec<i64> = counts.iter().map(|c| c[axis]).collect();
            axis_counts.keep_limits(&mut positions);
            counts.iter_mut().zip(positions).for_each(|(c, p)| c[axis] = p);
        }
    }

    /// Returns the lowest and the highest count of an axis within its travel; all integers if its travel is not
    /// limited.
    fn travel_counts(&self, axis: usize) -> [i64; 2] {
        let count = self.plan.grids[axis].count;
        match self.plan.axes[axis].travel {
            // A hair is the rounding of the division.
            Some([low, high]) => {
                [(low / count - 1e-7).ceil() as i64, (high / count + 1e-7).floor() as i64]
            }
            None => [i64::MIN, i64::MAX],
        }
    }

    /// Returns a position in counts, moved into the travel. Refuses one that a float cannot hold exactly; `k` is the
    /// node in the message. `position` is that of the axis number `axis`, mm or deg.
    fn count(&self, k: usize, axis: usize, position: f64) -> Result<i64, Invalid> {
        let count = self.plan.grids[axis].count;
        let counts = position / count;
        if counts.is_nan() || counts.abs() >= LARGEST_EXACT_INTEGER {
            let remedy = "give a larger count";
            return Err(Invalid::at_index("node", k, format!("is at {counts:e} counts"), remedy));
        }
        let [low, high] = self.travel_counts(axis);
        Ok((counts.round() as i64).min(high).max(low))
    }

    /// Returns a text with the largest count in mm, and in degrees if an axis is rotary.
    fn largest_counts(&self) -> String {
        let mut texts = Vec::new();
        for (is_rotary, unit) in [(false, "mm"), (true, "deg")] {
            let counts = self.plan.grids.iter().zip(self.plan.axes);
            let counts = counts.filter(|(_, axis)| axis.is_rotary == is_rotary);
            if let Some(largest) = counts.map(|(grid, _)| grid.count).reduce(f64::max) {
                texts.push(format!("{largest} {unit}"));
            }
        }
        texts.join(" and ")
    }

    /// Returns the largest distance of the executed contact point from the one of the plan at the nearest instant, mm,
    /// at points of every cubic. `None` if the plan knows no contact point. `motion` is the plan on the clock of the
    /// program, and `nodes` the program.
    fn contact_mm(&self, motion: &Slowed<N>, nodes: &Nodes<N>) -> Result<Option<f64>, Invalid> {
        let Some(contact) = self.plan.contact else { return Ok(None) };
        let mut largest: f64 = 0.0;
        for piece in nodes.pieces() {
            for j in 0..=CONTACT_POINTS {
                let u = piece.time_s * j as f64 / CONTACT_POINTS as f64;
                let here = position(&piece.coefficient, u);
                let plan_s = motion.nearest_plan_s(piece.start_s + u, here);
                let there = at_plan(self.plan, plan_s).position;
                let (Some(p), Some(q)) = (contact(&here), contact(&there)) else {
                    let problem = format!(
                        "puts the tool where it meets no surface, at {:.6} s",
                        piece.start_s + u
                    );
                    let remedy = "give the `form` that the motion was made for, with its overscan";
                    return Err(Invalid::at_index("segment", piece.segment, problem, remedy));
                };
                largest = largest.max((p[0] - q[0]).hypot(p[1] - q[1]));
            }
        }
        Ok(Some(largest))
    }

    /// Computes the velocities of all axes at the nodes, and raises `excess` where a segment exceeds a limit (factor on
    /// its time).
    fn solve(&self, nodes: &mut Nodes<N>, excess: &mut [f64]) {
        let n = nodes.segments();
        let time_s: Vec<f64> = (0..n).map(|k| nodes.segment_s(k)).collect();
        let mut rests = vec![false; n + 1];
        rests[0] = true;
        rests[n] = true;
        for (a, limits) in self.plan.axes.iter().enumerate() {
            let distance: Vec<f64> =
                (0..n).map(|k| nodes.distance(k)[a] as f64 * nodes.count[a]).collect();
            let planned: Vec<f64> = nodes.velocity.iter().map(|v| v[a]).collect();
            let axis = Axis {
                distance: &distance,
                time_s: &time_s,
                planned: &planned,
                limits,
                unit: self.plan.grids[a].velocity,
                rests: &rests,
            };
            let (velocity, over) = axis.velocities();
            for (node, v) in nodes.velocity.iter_mut().zip(velocity) {
                node[a] = v;
            }
            excess.iter_mut().zip(over).for_each(|(e, o)| *e = e.max(o));
        }
    }

    /// Computes the velocities of `nodes`, and returns the faults of the program. `motion` is the plan on the clock of
    /// the program, to which it is compared.
    fn finish(&self, motion: &Slowed<N>, nodes: &mut Nodes<N>) -> Faults<N> {
        let n = nodes.segments();
        let mut excess = vec![1.0_f64; n];
        match nodes.interpolation {
            Interpolation::Hermite => self.solve(nodes, &mut excess),
            Interpolation::Linear => nodes.velocity.fill([0.0; N]),
        }
        let mut faults =
            Faults { slow: vec![], long: vec![], beyond: [[0.0; 2]; N], deviation_mm: 0.0 };
        let most = 1.0 + LIMIT_ROUNDING;
        let pieces = nodes.pieces();
        if self.plan.may_step && nodes.interpolation == Interpolation::Hermite {
            for step in acceleration_steps(&pieces, self.plan.axes) {
                // Time that is longer by a factor f makes the step smaller by f^2, and what is allowed larger by f.
                let over = (step.value / step.allowed).cbrt();
                for i in [step.node.saturating_sub(1), step.node.min(n - 1)] {
                    if over > most {
                        excess[i] = excess[i].max(over);
                    }
                }
            }
        }
        for piece in pieces {
            let i = piece.segment;
            let over = use_of_limits(&piece, self.plan.axes, nodes.interpolation);
            if over > most {
                excess[i] = excess[i].max(over);
            }
            for (axis, limits) in self.plan.axes.iter().enumerate() {
                let Some([low, high]) = limits.travel else { continue };
                let r = range(&piece.coefficient[axis], piece.time_s);
                for (side, over) in [low - r.min, r.max - high].into_iter().enumerate() {
                    let is_far =
                        self.plan.lever[axis] * over > FAR_BEYOND * self.settings.path_deviation_mm;
                    if is_far && nodes.duration(i) > self.least_ticks {
                        faults.long.push(i);
                    } else if over > TRAVEL_ROUNDING {
                        let beyond = &mut faults.beyond[axis][side];
                        *beyond = beyond.max(over);
                    }
                }
            }
            let worth_mm = WORTH * self.settings.path_deviation_mm;
            let off_mm = motion.bound_mm(piece.start_s, piece.time_s, &piece.coefficient, worth_mm);
            faults.deviation_mm = faults.deviation_mm.max(off_mm);
            let too_far = off_mm / self.settings.path_deviation_mm;
            // What lies between two switches is not cut below two of the shortest segments. Shorter lines would be rounded
            // more.
            let is_linear = nodes.interpolation == Interpolation::Linear;
            if too_far > 1.0 && !is_linear && nodes.duration(i) >= 2 * self.least_ticks {
                if faults.long.last() != Some(&i) {
                    faults.long.push(i);
                }
            } else if too_far > 1.0 {
                // Positions of lines are late where the plan leaves no room for rounding; a little more time leaves it.
                let growth = if is_linear { LEAST_GROWTH } else { 0.1 * (too_far - 1.0) };
                excess[i] = excess[i].max(1.0 + growth);
            }
        }
        let over = excess.iter().enumerate().filter(|(_, e)| **e > 1.0);
        faults.slow = over.map(|(k, e)| (k, *e)).collect();
        faults
    }
}

/// Step of the acceleration of an axis at a node, in the unit of the axis per s^2.
pub(crate) struct AccelerationStep {
    pub node: usize,
    pub axis: usize,
    pub value: f64,
    /// Step that the limit on jerk J allows: J (T1 + T2) / 2 with the durations beside the node. The axes rest before
    /// and after the motion.
    pub allowed: f64,
}

/// Returns the steps of the acceleration between consecutive cubics, for the axes with a limit on jerk.
pub(crate) fn acceleration_steps<const N: usize>(
    pieces: &[ExecutedCubic<N>],
    axes: &[MachineAxis; N],
) -> Vec<AccelerationStep> {
    let mut steps = Vec::new();
    for node in 0..=pieces.len() {
        let before = node.checked_sub(1).and_then(|k| pieces.get(k));
        let after = pieces.get(node);
        let time_s = before.map_or(0.0, |p| p.time_s) + after.map_or(0.0, |p| p.time_s);
        for (axis, limits) in axes.iter().enumerate() {
            let Some(jerk) = limits.max_jerk else { continue };
            let end = before.map_or(0.0, |p| p.acceleration(axis, p.time_s));
            let start = after.map_or(0.0, |p| p.acceleration(axis, 0.0));
            let allowed = 0.5 * jerk * time_s;
            steps.push(AccelerationStep { node, axis, value: (start - end).abs(), allowed });
        }
    }
    steps
}

impl<const N: usize> ExecutedCubic<N> {
    /// Returns the acceleration of an axis at the time `u` since the start of the cubic, in the unit of the axis per
    /// s^2.
    fn acceleration(&self, axis: usize, u: f64) -> f64 {
        evaluate(&derivative(&derivative(&self.coefficient[axis])), u)
    }
}

/// Returns the shortest time of a segment, s, by the rounding of its ends. In it the rounding to a count c and that to
/// a unit of velocity q each use at most the fraction [`ROUNDING`] (r) of the limits on acceleration A and jerk J:
///
/// ```text
/// 6 c / T^2 <= r A,   3 q / T <= r A,   12 c / T^3 <= r J,   6 q / T^2 <= r J
/// ```
fn least_for_rounding_s<const N: usize>(plan: &AxesPlan<N>) -> f64 {
    let mut least_s = 0.0_f64;
    for (grid, limits) in plan.grids.iter().zip(plan.axes) {
        let AxisGrid { count, velocity: unit } = *grid;
        let a = ROUNDING * limits.max_acceleration;
        // The larger of two terms, doubled, is at least their sum.
        least_s = least_s.max((6.0 * count / a).sqrt()).max(3.0 * unit / a);
        if let Some(jerk) = limits.max_jerk {
            let j = ROUNDING * jerk;
            least_s = least_s.max((12.0 * count / j).cbrt()).max((6.0 * unit / j).sqrt());
        }
    }
    least_s
}

/// Fraction of the limits on acceleration and jerk that rounding to counts may use in the shortest segments. Larger:
/// shorter segments, nearer to the plan at steps of the acceleration, but slower where the plan is at its limit.
/// Smaller: longer segments. Chosen.
const ROUNDING: f64 = 0.1;

/// Upper bound of the shortest segment that follows from rounding, s. Larger: long segments on slow axes, which have
/// less to round. Smaller: rounding may use more of the limits. Chosen.
const LONGEST_LEAST_S: f64 = 0.05;

/// Excess of the travel that counts as rounding of a coordinate, mm or deg. Larger: axes may leave their travel by it.
/// Smaller: rounding is mended in further rounds. Chosen far below a count.
const TRAVEL_ROUNDING: f64 = 1e-9;

/// Returns the factor by which the time of a cubic has to grow so that it keeps the limits on velocity, acceleration
/// and, for a program of cubics, jerk; at most 1 if it keeps them.
fn use_of_limits<const N: usize>(
    piece: &ExecutedCubic<N>,
    axes: &[MachineAxis; N],
    interpolation: Interpolation,
) -> f64 {
    let mut most = 0.0_f64;
    for (c, limits) in piece.coefficient.iter().zip(axes) {
        let v = derivative(c);
        let a = derivative(&v);
        let peak = |c: &[f64; 4]| range(c, piece.time_s).peak().0;
        most = most
            .max(peak(&v) / limits.max_velocity)
            .max((peak(&a) / limits.max_acceleration).sqrt());
        // The acceleration of joined lines has steps, as that of every parabola between lines.
        if interpolation == Interpolation::Hermite
            && let Some(jerk) = limits.max_jerk
        {
            most = most.max((derivative(&a)[0].abs() / jerk).cbrt());
        }
    }
    most
}

/// Refuses counts that are not positive, that are below [`SMALLEST_COUNT`], or that are larger than the whole motion.
fn check_counts<const N: usize>(plan: &AxesPlan<N>) -> Result<(), Invalid> {
    let extents_mm = (0..N).map(|a| plan.lever[a] * plan.extent(a));
    let extent_mm = extents_mm.fold(f64::NEG_INFINITY, f64::max);
    for ((grid, limits), lever) in plan.grids.iter().zip(plan.axes).zip(plan.lever) {
        let name = name_of_count(limits);
        let unit = limits.unit();
        let c = grid.count;
        let remedy = format!("give the size of an encoder count in {unit}");
        crate::positive(name, c)?;
        if c < SMALLEST_COUNT {
            let problem = format!("is {c}, a program has nine decimals of a {unit}");
            return Err(Invalid::whole(name, problem, remedy));
        }
        if lever * c > extent_mm && extent_mm > 0.0 {
            let problem = format!("is {c}, the whole motion goes {extent_mm} mm");
            return Err(Invalid::whole(name, problem, remedy));
        }
    }
    Ok(())
}

/// Returns the name of the setting that states the count of an axis.
fn name_of_count(axis: &MachineAxis) -> &'static str {
    if axis.is_rotary { "count_deg" } else { "count_mm" }
}
