//! The part of a program between two of its marks, from rest to rest.
//!
//! A mark is a node, where a segment begins. The nodes between the two marks are those of the whole program, and so are
//! its lines. Where the motion does not rest at a mark, a run-up goes before it, or a run-down after it, with the tool
//! off. Over its duration 2 h the acceleration of an axis is continuous and linear in two pieces, 0 to a_m to a,
//!
//! ```text
//! a_m = v / h - a / 2        so that the velocity grows from 0 to v
//! ```
//!
//! with the velocity v and the acceleration a of the axis at the mark. Every piece is a cubic, which a controller with
//! cubics runs as it is. For lines v is that of the line at the mark, and a is 0. A run-down is the run-up to -v, back
//! in time. The shortest h is taken with which the motion keeps the limits and the travel of the machine.

use std::array::from_fn;

use planish_numerics::polynomial::{derivative, evaluate};
use planish_types::{Interpolation, Invalid};

use crate::{generate::Nodes, limits, plan::AxesPlan};

/// Longest half of a run-up, s. Larger: the search for one that keeps the limits takes longer. Smaller: fast motions
/// are refused. Chosen: no figuring machine takes a minute to its speed.
const LONGEST_HALF_S: f64 = 30.0;

/// Ratio of the halves of two run-ups that are tried one after the other. Larger: run-ups that are longer than needed.
/// Smaller: more trials.
const GROWTH: f64 = 1.15;

/// Longest line of a run-up of lines, s. Larger: corners beyond the path tolerance. Smaller: more lines.
const LONGEST_LINE_S: f64 = 0.01;

/// Limits of a run-up that are not those of the machine.
pub(crate) struct RunUpLimits {
    /// Shortest and longest segment, ticks.
    pub ticks: [i64; 2],
    /// Largest distance of joined lines from their corners, mm; the controller joins no others.
    pub tolerance_mm: f64,
}

/// Numbers of the segments of the run-up and of the run-down.
pub(crate) type Ramps = [usize; 2];

/// Returns the nodes from mark `from` to mark `to` with run-up and run-down, and the numbers of their segments. Refuses
/// marks that the program does not have, and marks for which no run-up keeps the limits and the travel of the machine.
pub(crate) fn between<const N: usize>(
    whole: &Nodes<N>,
    plan: &AxesPlan<N>,
    [from, to]: [usize; 2],
    run_up: &RunUpLimits,
) -> Result<(Nodes<N>, Ramps), Invalid> {
    let n = whole.segments();
    if from >= to || to > n {
        let problem = format!("are {from} to {to}, and the program has the marks 0 to {}", n - 1);
        return Err(Invalid::whole("marks", problem, "give a mark of the program"));
    }
    let mut nodes = slice(whole, from, to);
    let mut ramps = [0, 0];
    if !rests(whole, from) {
        let first = slice(&nodes, 0, 1);
        let before = ramp(&first, plan, run_up).map_err(|e| refused(from, "run-up to", &e))?;
        ramps[0] = before.segments();
        nodes = joined(&before, &nodes);
    }
    if !rests(whole, to) {
        let n = nodes.segments();
        let last = reversed(&slice(&nodes, n - 1, n));
        let after = ramp(&last, plan, run_up).map_err(|e| refused(to, "run-down from", &e))?;
        ramps[1] = after.segments();
        nodes = joined(&nodes, &reversed(&after));
    }
    Ok((nodes, ramps))
}

fn refused(mark: usize, what: &str, e: &Invalid) -> Invalid {
    let problem = format!("{mark}: no {what} it keeps the limits: {}[..] {}", e.array, e.problem);
    Invalid::whole("mark", problem, "give another mark, or plan the rest by planish resume")
}

/// Returns true if the axes rest at node `k` of the whole program.
fn rests<const N: usize>(nodes: &Nodes<N>, k: usize) -> bool {
    let n = nodes.segments();
    match nodes.interpolation {
        Interpolation::Hermite => nodes.velocity[k] == [0.0; N],
        Interpolation::Linear => k == 0 || k == n || nodes.stands(k) || nodes.stands(k - 1),
    }
}

/// Returns the nodes `from` to `to`, with times from 0.
fn slice<const N: usize>(whole: &Nodes<N>, from: usize, to: usize) -> Nodes<N> {
    let ticks = whole.ticks[from..=to].iter().map(|tick| tick - whole.ticks[from]);
    Nodes {
        ticks: ticks.collect(),
        counts: whole.counts[from..=to].to_vec(),
        velocity: whole.velocity[from..=to].to_vec(),
        tool_on: whole.tool_on[from..to].to_vec(),
        ..without_nodes(whole)
    }
}

/// Returns a motion with the grids of `nodes`, and no node.
fn without_nodes<const N: usize>(nodes: &Nodes<N>) -> Nodes<N> {
    Nodes {
        count: nodes.count,
        tick_s: nodes.tick_s,
        ticks: Vec::new(),
        counts: Vec::new(),
        velocity: Vec::new(),
        tool_on: Vec::new(),
        interpolation: nodes.interpolation,
        deviation_mm: nodes.deviation_mm,
        contact_mm: nodes.contact_mm,
        added_s: nodes.added_s,
        uneven: nodes.uneven,
    }
}

/// Returns the motion back in time.
fn reversed<const N: usize>(nodes: &Nodes<N>) -> Nodes<N> {
    let end = nodes.ticks[nodes.segments()];
    let opposite = |v: &[f64; N]| from_fn(|a| if v[a] == 0.0 { 0.0 } else { -v[a] });
    Nodes {
        ticks: nodes.ticks.iter().rev().map(|tick| end - tick).collect(),
        counts: nodes.counts.iter().rev().copied().collect(),
        velocity: nodes.velocity.iter().rev().map(opposite).collect(),
        tool_on: nodes.tool_on.iter().rev().copied().collect(),
        ..without_nodes(nodes)
    }
}

/// Returns both motions, the second after the first, which ends at its first node.
fn joined<const N: usize>(first: &Nodes<N>, second: &Nodes<N>) -> Nodes<N> {
    let n = first.segments();
    let mut nodes = first.clone();
    nodes.ticks.extend(second.ticks[1..].iter().map(|tick| first.ticks[n] + tick));
    nodes.counts.extend(&second.counts[1..]);
    // The velocity at the joint is that of the second motion.
    nodes.velocity[n] = second.velocity[0];
    nodes.velocity.extend(&second.velocity[1..]);
    nodes.tool_on.extend(&second.tool_on);
    nodes
}

/// Returns the shortest motion from rest to the beginning of the segment `first` that keeps the limits.
fn ramp<const N: usize>(
    first: &Nodes<N>,
    plan: &AxesPlan<N>,
    run_up: &RunUpLimits,
) -> Result<Nodes<N>, Invalid> {
    let [least, most] = run_up.ticks;
    // Without a tolerance the controller joins no lines.
    let tolerance_mm = if run_up.tolerance_mm > 0.0 { run_up.tolerance_mm } else { f64::INFINITY };
    let most_half = (LONGEST_HALF_S / first.tick_s) as i64;
    // The accelerations are continuous by the formula; the proof of the whole program judges their rounding.
    let plan = &AxesPlan { may_step: false, ..*plan };
    let mut beyond_travel = None;
    let mut half = least.max(1);
    loop {
        let pieces = pieces(first, half, [least, most]);
        let ramp = with_half(first, plan, half / pieces * pieces, pieces);
        // Its joint with the segment is proven, too; the motion goes on from there.
        let with_joint = joined(&ramp, first);
        let proof = limits::prove_to_last_node(&with_joint, plan);
        if proof.is_ok() && farthest_mm(&with_joint, plan) <= tolerance_mm {
            return Ok(ramp);
        }
        let fault = proof
            .err()
            .unwrap_or_else(|| Invalid::whole("run-up", "has lines beyond the path tolerance", ""));
        // The travel is what a longer run-up leaves; the limits are what a shorter one exceeds.
        if half >= most_half {
            return Err(beyond_travel.unwrap_or(fault));
        }
        if fault.array == "program" {
            beyond_travel.get_or_insert(fault);
        }
        half = ((half as f64 * GROWTH).ceil() as i64).min(most_half);
    }
}

/// Returns the number of segments of a half of `half` ticks: one if the controller takes it, several of short lines.
fn pieces<const N: usize>(rest: &Nodes<N>, half: i64, [least, most]: [i64; 2]) -> i64 {
    let longest = match rest.interpolation {
        Interpolation::Hermite => most,
        Interpolation::Linear => most.min((LONGEST_LINE_S / rest.tick_s) as i64).max(least),
    };
    // No piece is shorter than the least.
    ((half + longest - 1) / longest).clamp(1, (half / least).max(1))
}

/// Returns the run-up with halves of `half` ticks, in `pieces` segments each.
fn with_half<const N: usize>(
    rest: &Nodes<N>,
    plan: &AxesPlan<N>,
    half: i64,
    pieces: i64,
) -> Nodes<N> {
    let h = half as f64 * rest.tick_s;
    let [v, a] = state(rest);
    let end = rest.position(0);
    // a_m = v / h - a / 2
    let middle: [f64; N] = from_fn(|i| v[i] / h - a[i] / 2.0);
    let n = 2 * pieces;
    let mut nodes = without_nodes(rest);
    nodes.ticks = (0..=n).map(|k| k * (half / pieces)).collect();
    nodes.tool_on = vec![false; n as usize];
    for tick in nodes.ticks.clone() {
        let t = tick as f64 * rest.tick_s;
        let moved: [[f64; 2]; N] = from_fn(|i| since_rest(middle[i], a[i], h, t));
        let whole: [[f64; 2]; N] = from_fn(|i| since_rest(middle[i], a[i], h, 2.0 * h));
        nodes.counts.push(from_fn(|i| {
            ((end[i] - whole[i][0] + moved[i][0]) / rest.count[i]).round() as i64
        }));
        nodes.velocity.push(from_fn(|i| match rest.interpolation {
            Interpolation::Hermite => rounded(moved[i][1], plan.grids[i].velocity),
            Interpolation::Linear => 0.0,
        }));
    }
    nodes
}

/// Returns `v` as a multiple of `unit`.
fn rounded(v: f64, unit: f64) -> f64 {
    let n = (v / unit).round();
    if n == 0.0 { 0.0 } else { n * unit }
}

/// Returns velocity and acceleration of every axis at the first node.
fn state<const N: usize>(rest: &Nodes<N>) -> [[f64; N]; 2] {
    match rest.interpolation {
        Interpolation::Hermite => {
            let first = slice(rest, 0, 1).pieces();
            let second = first[0].coefficient.map(|c| evaluate(&derivative(&derivative(&c)), 0.0));
            [rest.velocity[0], second]
        }
        Interpolation::Linear => {
            let seconds = rest.duration(0) as f64 * rest.tick_s;
            [from_fn(|i| rest.distance(0)[i] as f64 * rest.count[i] / seconds), [0.0; N]]
        }
    }
}

/// Returns distance and velocity at the time `t` after the start, with the acceleration 0 at 0, `middle` at `h` and
/// `last` at 2 `h`, linear between.
fn since_rest(middle: f64, last: f64, h: f64, t: f64) -> [f64; 2] {
    let first = t.min(h);
    // v = a_m t^2 / 2h,  p = a_m t^3 / 6h
    let v = middle * first * first / (2.0 * h);
    let p = middle * first * first * first / (6.0 * h);
    let u = (t - h).max(0.0);
    // v = v_h + a_m u + (a - a_m) u^2 / 2h,  p = p_h + v_h u + a_m u^2 / 2 + (a - a_m) u^3 / 6h
    let change = (last - middle) / h;
    [p + u * (v + u * (middle / 2.0 + u * change / 6.0)), v + u * (middle + u * change / 2.0)]
}

/// Returns the largest distance of joined lines from their corners but the last one, along the linear axes, mm; 0 for
/// cubics.
fn farthest_mm<const N: usize>(nodes: &Nodes<N>, plan: &AxesPlan<N>) -> f64 {
    if nodes.interpolation == Interpolation::Hermite {
        return 0.0;
    }
    let seconds = |k: usize| nodes.duration(k) as f64 * nodes.tick_s;
    let mean = |k: usize| -> [f64; N] {
        from_fn(|i| nodes.distance(k)[i] as f64 * nodes.count[i] / seconds(k))
    };
    let mut farthest: f64 = 0.0;
    for k in 0..nodes.segments() {
        let (before, shorter_s) = match k.checked_sub(1) {
            Some(j) => (mean(j), seconds(j).min(seconds(k))),
            None => ([0.0; N], seconds(k)),
        };
        let linear = (0..N).filter(|i| !plan.axes[*i].is_rotary);
        let change = linear.map(|i| mean(k)[i] - before[i]).fold(0.0, f64::hypot);
        // |change of velocity| T / 8
        farthest = farthest.max(change * shorter_s / 8.0);
    }
    farthest
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Checks that the run-up ends at the velocity v with a continuous acceleration, by its derivatives.
    #[test]
    fn the_run_up_grows_from_rest_to_the_state_of_the_mark() {
        for (v, a, h) in [(3.0, 0.0, 0.5), (-2.0, 40.0, 0.25), (0.1, -200.0, 0.01)] {
            let middle = v / h - a / 2.0;
            let moved = |t: f64| since_rest(middle, a, h, t);
            assert_eq!(moved(0.0), [0.0, 0.0]);
            assert!((moved(2.0 * h)[1] - v).abs() < 1e-12 * (1.0 + v.abs()), "{v} {a}");
            for t in [0.3 * h, h, 1.7 * h] {
                let d = 1e-5 * h;
                let slope = (moved(t + d)[0] - moved(t - d)[0]) / (2.0 * d);
                // Central differences of a cubic are off by d^2 / 6 of the jerk.
                assert!((slope - moved(t)[1]).abs() < 1e-8 * (1.0 + v.abs() + a.abs()), "{v} {t}");
            }
        }
    }
}
