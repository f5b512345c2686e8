//! The real-time interpolator: reference positions, tick by tick, from the nodes of a dwell-time
//! density.
//!
//! A controller is given one block after the other, as a numerical control (NC) program: where the
//! block ends, the dwell-time densities `tau1`, `tau2` (s/mm) at its ends, and their arc lengths
//! `s1`, `s2` (mm). At tick `k`, with `T_k` the sum of the times of the blocks before,
//!
//! ```text
//! t = k t_tick - T_k,  T = (s2 - s1)(tau1 + tau2)/2,  e = (tau2 - tau1)/(tau1 + tau2)
//! x - e/pi sin(pi x) = t/T                      solved for x, the part of the length
//! P = P1 + (P2 - P1) x                          on a line
//! P = (1-x)^2 P1 + 2 x (1-x) C + x^2 P2,  x = t/T      on a blend of constant tau with corner C
//! feed = |dP/dt|:  1/D on a line,  2 |(1-x)(C - P1) + x (P2 - C)| / T  on a blend, where it is less than 1/tau
//! ```
//!
//! The interpolator keeps only the present block. The last tick is the end of the program.
//!
//! A program is text, one record per line, the words in any order, lengths in mm, densities in s/mm:
//!
//! ```text
//! (comment)
//! N00000 X1.5 Y2 Z0 S0                                   a pass starts here, at this arc length
//! N00001 X2.5 Y2 Z0 P0.1 Q0.12 R0 S1                     line: tau1 P, tau2 Q, s1 R, s2 S
//! N00002 X3 Y2.5 Z0 I3 J2 P0.12 Q0.12 R1 S2              blend: corner I, J
//! ```
//!
//! Z is the height of the part at the end of the record, 0 without a form. The records state lengths, densities and
//! velocities in the plane of the part, and this interpolator reads no Z.
//!
//! The run-up accelerates the tool to the first pass, lifts lead from one pass to the next, and the brake ends the
//! motion. They are cubics in time, from the present position and velocity of the tool to a point with a velocity
//! (mm/s) after a time (s). [`linked_records`] takes them from the trajectory of the schedule:
//!
//! ```text
//! N00003 X5 Y5 Z0 U0 V2 T0.75 K0                         cubic: velocity U, V at the end, time T, tool K (1 on, 0 off)
//! ```
//!
//! A pass that starts elsewhere than the tool is, without such a record, is refused.
//!
//! Source: the real-time interpolation of Opt. Express 32 (2024) 9255 (blocks of end point, tau1,
//! tau2, s1, s2); the records for blends and cubics are ours.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | tau | `density_s_per_mm` | (2) | s/mm |
//! | s | `arc_length_mm` | (2) | mm |
//! | P2, C | `end_mm`, `corner_mm` | (2) | mm |
//! | t_tick | `tick_s` | - | s |

use planish_numerics::polynomial::{derivative, evaluate};
use planish_types::{DwellDensity, Segment, Trajectory};

use crate::{hermite, trig_spline::TrigPiece};

/// Largest difference between a length stated in a program and the distance of its points that counts as equal, mm. It
/// also bounds the gap between the end of a record and the start of the next one.
const SAME_LENGTH_MM: f64 = 1e-6;

/// Block of a program: a line, or a blend (parabola) when it has a corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Block {
    /// End point of the block [x, y], mm.
    pub end_mm: [f64; 2],
    /// Corner of the path that the blend rounds, its middle control point [x, y], mm; `None` for a line.
    pub corner_mm: Option<[f64; 2]>,
    /// Dwell-time densities at the start and at the end of the block, s/mm.
    pub density_s_per_mm: [f64; 2],
    /// Arc lengths at the start and at the end of the block, mm.
    pub arc_length_mm: [f64; 2],
}

/// Record of a program: the content of one line of its text.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Record {
    /// Start of a pass (a run of the path with the tool on).
    Start {
        /// Position [x, y], mm.
        point_mm: [f64; 2],
        /// Arc length at that position, mm.
        arc_length_mm: f64,
    },
    /// Motion along a pass.
    Block(Block),
    /// Motion outside of the passes, or rest.
    Cubic(Cubic),
}

/// Cubic in time from the present position and velocity of the tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cubic {
    /// End point [x, y], mm.
    pub end_mm: [f64; 2],
    /// Velocity at the end [x, y], mm/s.
    pub velocity_mm_per_s: [f64; 2],
    /// Duration, s.
    pub duration_s: f64,
    /// True if the tool is on and removes material.
    pub tool_on: bool,
}

/// Returns the records of `density` in order: a start for each pass, and a block for each line or blend.
pub fn records(density: &DwellDensity) -> impl Iterator<Item = Record> + '_ {
    let s = density.arc_length_mm();
    let d = density.dwell_density_s_per_mm();
    let p = density.point_mm();
    // A corner is part of the block that ends at the node after it.
    (0..density.len()).filter(|i| !density.corner()[*i]).map(move |i| {
        if i == 0 || density.pass_idx()[i] != density.pass_idx()[i - 1] {
            return Record::Start { point_mm: p[i], arc_length_mm: s[i] };
        }
        let corner = density.corner()[i - 1];
        let from = if corner { i - 2 } else { i - 1 };
        Record::Block(Block {
            end_mm: p[i],
            corner_mm: if corner { Some(p[i - 1]) } else { None },
            density_s_per_mm: [d[from], d[i]],
            arc_length_mm: [s[from], s[i]],
        })
    })
}

/// Returns the [`records`] with the run-up, the lifts and the brake of `trajectory`, which was scheduled together with
/// `density`.
///
/// # Errors
///
/// Refuses a trajectory whose passes are not those of `density`. The text says where the two differ.
pub fn linked_records(
    density: &DwellDensity,
    trajectory: &Trajectory,
) -> Result<Vec<Record>, String> {
    let n = trajectory.len();
    let mut all: Vec<Record> = Vec::with_capacity(density.len() + n);
    let first = trajectory.segment(0);
    let point_mm = first.coefficient_mm.map(|c| c[0]);
    if !is_of_a_pass(&first) {
        all.push(Record::Start { point_mm, arc_length_mm: 0.0 });
    }
    let mut next = 0;
    let mut pass_end_s = f64::NEG_INFINITY;
    // Break times and sums of blocks are rounded differently.
    let same_s = 1e-9 * trajectory.total_time_s();
    for record in records(density) {
        match &record {
            Record::Start { point_mm, .. } => {
                while next < n && trajectory.segment(next).start_s < pass_end_s - same_s {
                    next += 1;
                }
                while next < n && !is_of_a_pass(&trajectory.segment(next)) {
                    all.push(cubic_record(trajectory.segment(next)));
                    next += 1;
                }
                if next == n {
                    return Err(differs("a pass is missing at the end"));
                }
                let begin = trajectory.segment(next);
                let start_mm = begin.coefficient_mm.map(|c| c[0]);
                if distance(start_mm, *point_mm) > SAME_LENGTH_MM {
                    return Err(differs(&format!(
                        "the pass that starts at {point_mm:?} mm starts at {start_mm:?} mm in segment {next}"
                    )));
                }
                pass_end_s = begin.start_s;
            }
            Record::Block(block) => pass_end_s += block.piece().duration_s(),
            Record::Cubic(_) => unreachable!("a density has none"),
        }
        all.push(record);
    }
    while next < n && trajectory.segment(next).start_s < pass_end_s - same_s {
        next += 1;
    }
    for k in next..n {
        let segment = trajectory.segment(k);
        if is_of_a_pass(&segment) {
            return Err(differs(&format!("segment {k} moves after the last pass")));
        }
        all.push(cubic_record(segment));
    }
    Ok(all)
}

/// Returns the error message for a trajectory that does not belong to the density; `what` names the difference.
fn differs(what: &str) -> String {
    format!("{what}: the trajectory is not the one that was scheduled with this feed")
}

/// Returns true for a segment along a pass: the tool is on and the tool moves.
fn is_of_a_pass(s: &Segment<'_>) -> bool {
    s.tool_on && s.coefficient_mm.iter().any(|c| c[1..].iter().any(|c| *c != 0.0))
}

/// Returns the cubic record of a segment outside of the passes: run-up, lift, brake or rest.
fn cubic_record(s: Segment<'_>) -> Record {
    let [(x, u), (y, v)] = s.coefficient_mm.map(|c| end_of(&c, s.duration_s));
    Record::Cubic(Cubic {
        end_mm: [x, y],
        velocity_mm_per_s: [u, v],
        duration_s: s.duration_s,
        tool_on: s.tool_on,
    })
}

/// Returns the position, mm, and the velocity, mm/s, of a cubic with the coefficients `c` after the time `t`, s.
fn end_of(c: &[f64; 4], t: f64) -> (f64, f64) {
    (evaluate(c, t), evaluate(&derivative(c), t))
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (b[0] - a[0]).hypot(b[1] - a[1])
}

impl Block {
    fn piece(&self) -> TrigPiece {
        let [s1, s2] = self.arc_length_mm;
        TrigPiece { density_s_per_mm: self.density_s_per_mm, length_mm: s2 - s1 }
    }

    /// Returns the velocity at the end of the block [x, y], mm/s, if the block starts at the point `start`, mm.
    fn end_velocity(&self, start: [f64; 2]) -> [f64; 2] {
        let from = self.corner_mm.unwrap_or(start);
        let length = distance(from, self.end_mm);
        // At the end of a blend 2 (P2 - C) / T.
        let time_s = match self.corner_mm {
            None => length * self.density_s_per_mm[1],
            Some(_) => 0.5 * self.piece().duration_s(),
        };
        [0, 1].map(|a| (self.end_mm[a] - from[a]) / time_s)
    }
}

impl Record {
    /// Returns the end point of the record [x, y], mm.
    pub fn end_mm(&self) -> [f64; 2] {
        match self {
            Self::Start { point_mm, .. } => *point_mm,
            Self::Block(block) => block.end_mm,
            Self::Cubic(cubic) => cubic.end_mm,
        }
    }

    /// Returns the record as a line of a program, without a line break. `z_mm` is the height of the part at the end of
    /// the record; the numbers keep every digit.
    pub fn to_line(&self, number: usize, z_mm: f64) -> String {
        match self {
            Self::Start { point_mm: [x, y], arc_length_mm } => {
                format!("N{number:05} X{x} Y{y} Z{z_mm} S{arc_length_mm}")
            }
            Self::Block(b) => {
                let [x, y] = b.end_mm;
                let [p, q] = b.density_s_per_mm;
                let [r, s] = b.arc_length_mm;
                let corner = b.corner_mm.map_or(String::new(), |[i, j]| format!(" I{i} J{j}"));
                format!("N{number:05} X{x} Y{y} Z{z_mm}{corner} P{p} Q{q} R{r} S{s}")
            }
            Self::Cubic(c) => {
                let [x, y] = c.end_mm;
                let [u, v] = c.velocity_mm_per_s;
                let t = c.duration_s;
                let tool = u8::from(c.tool_on);
                format!("N{number:05} X{x} Y{y} Z{z_mm} U{u} V{v} T{t} K{tool}")
            }
        }
    }

    /// Reads a line of a program; returns `None` for an empty line or a comment. Refuses unknown, repeated, missing or
    /// contradicting words; the error names the word.
    pub fn parse(line: &str) -> Result<Option<Self>, String> {
        let line = line.trim();
        if line.is_empty() || line.starts_with('(') {
            return Ok(None);
        }
        let mut words = Words([None; 26]);
        for word in line.split_whitespace() {
            let (letter, number) = word.split_at(word.chars().next().map_or(0, char::len_utf8));
            let value: Option<f64> = number.parse().ok().filter(|v: &f64| v.is_finite());
            let known = letter.chars().all(|c| "NXYZIJPQRSUVTK".contains(c));
            let (Some(value), true) = (value, known) else {
                return Err(format!(
                    "the word {word:?} is not one of N X Y Z I J P Q R S U V T K with a finite number"
                ));
            };
            let place = &mut words.0[usize::from(letter.as_bytes()[0] - b'A')];
            if place.replace(value).is_some() {
                return Err(format!("the word {letter} stands twice"));
            }
        }
        let end_mm = [words.need('X')?, words.need('Y')?];
        if "UVTK".chars().any(|c| words.get(c).is_some()) {
            if let Some(other) = "IJPQRS".chars().find(|c| words.get(*c).is_some()) {
                return Err(format!("the word {other} does not stand beside U V T K"));
            }
            let tool = words.need('K')?;
            let duration_s = words.need('T')?;
            if tool != 0.0 && tool != 1.0 {
                return Err(format!("K is {tool}; it is 1 with the tool on, 0 with the tool off"));
            }
            if duration_s <= 0.0 {
                return Err(format!("T is {duration_s} s; give a positive time"));
            }
            return Ok(Some(Self::Cubic(Cubic {
                end_mm,
                velocity_mm_per_s: [words.need('U')?, words.need('V')?],
                duration_s,
                tool_on: tool == 1.0,
            })));
        }
        let s2 = words.need('S')?;
        if "PQRIJ".chars().all(|c| words.get(c).is_none()) {
            return Ok(Some(Self::Start { point_mm: end_mm, arc_length_mm: s2 }));
        }
        let corner_mm = match (words.get('I'), words.get('J')) {
            (Some(i), Some(j)) => Some([i, j]),
            (None, None) => None,
            _ => return Err("I and J stand together: the corner of a blend".into()),
        };
        Ok(Some(Self::Block(Block {
            end_mm,
            corner_mm,
            density_s_per_mm: [words.need('P')?, words.need('Q')?],
            arc_length_mm: [words.need('R')?, s2],
        })))
    }
}

/// Numbers of the words of a line, indexed by the letter of the word from A to Z; `None` for a letter without a word.
struct Words([Option<f64>; 26]);

impl Words {
    fn get(&self, letter: char) -> Option<f64> {
        self.0[letter as usize - 'A' as usize]
    }

    /// Returns the number of the word with this letter; an error if the line does not have it.
    fn need(&self, letter: char) -> Result<f64, String> {
        self.get(letter).ok_or_else(|| format!("the word {letter} is missing"))
    }
}

/// Reference for the position loop of the controller at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reference {
    /// Time since the start of the program, s.
    pub time_s: f64,
    /// Position [x, y], mm.
    pub position_mm: [f64; 2],
    /// Feedrate, mm/s: the magnitude of the velocity.
    pub feed_mm_per_s: f64,
    /// Number of the pass in which the tool is, from 0; -1 while the tool is off.
    pub pass_idx: i64,
}

/// State of the interpolator in the program.
#[derive(Clone, Debug)]
pub struct Interpolator {
    tick_s: f64,
    /// Number of the next tick.
    tick: u64,
    /// Sum of the times of the records before, s, and the rounding error of that sum (Kahan summation).
    start_s: f64,
    lost_s: f64,
    pass_idx: i64,
    before: Option<Before>,
}

/// State at the end of the previous record.
#[derive(Clone, Copy, Debug)]
struct Before {
    point_mm: [f64; 2],
    velocity_mm_per_s: [f64; 2],
    arc_length_mm: f64,
    /// Number of the pass in which the tool is, from 0; -1 outside.
    pass_idx: i64,
    /// False until a record has moved the tool.
    has_moved: bool,
    /// True after the start of a pass and after a block: the next record can be a block.
    in_pass: bool,
}

impl Interpolator {
    /// Creates an interpolator at the start of a program.
    ///
    /// # Errors
    ///
    /// Refuses a time `tick_s` between two references that is not positive and finite.
    pub fn new(tick_s: f64) -> Result<Self, String> {
        if !(tick_s.is_finite() && tick_s > 0.0) {
            return Err(format!("the tick is {tick_s} s; give a positive time"));
        }
        Ok(Self { tick_s, tick: 0, start_s: 0.0, lost_s: 0.0, pass_idx: -1, before: None })
    }

    /// Returns the duration of all records so far, s.
    pub fn duration_s(&self) -> f64 {
        self.start_s
    }

    /// Runs one record and passes the references of its ticks to `emit`, in order.
    ///
    /// Refuses a record that does not continue the previous one, and a block whose numbers contradict each other.
    /// Refuses a block outside of a pass, and a cubic before the first start of a pass.
    pub fn push(&mut self, record: &Record, emit: impl FnMut(Reference)) -> Result<(), String> {
        match record {
            Record::Start { point_mm, arc_length_mm } => {
                let before = self.before.filter(|b| b.has_moved);
                if let Some(b) = before.filter(|b| distance(b.point_mm, *point_mm) > SAME_LENGTH_MM)
                {
                    return Err(format!(
                        "the pass starts at {point_mm:?} mm, the tool is at {:?} mm, and nothing takes it there; \
                         give `trajectory` (where the program is written, if this is one), which has the way",
                        b.point_mm
                    ));
                }
                self.before = Some(Before {
                    point_mm: *point_mm,
                    velocity_mm_per_s: before.map_or([0.0; 2], |b| b.velocity_mm_per_s),
                    arc_length_mm: *arc_length_mm,
                    pass_idx: -1,
                    has_moved: before.is_some(),
                    in_pass: true,
                });
                Ok(())
            }
            Record::Block(block) => self.run(block, emit),
            Record::Cubic(cubic) => self.link(cubic, emit),
        }
    }

    /// Returns the reference at the end of the program; `None` if a tick falls on that end or if nothing has moved.
    pub fn finish(self) -> Option<Reference> {
        let before = self.before.filter(|b| b.has_moved)?;
        let last_tick_s = (self.tick.max(1) - 1) as f64 * self.tick_s;
        if last_tick_s >= self.start_s {
            return None;
        }
        let [u, v] = before.velocity_mm_per_s;
        Some(Reference {
            time_s: self.start_s,
            position_mm: before.point_mm,
            feed_mm_per_s: u.hypot(v),
            pass_idx: before.pass_idx,
        })
    }

    fn run(&mut self, block: &Block, mut emit: impl FnMut(Reference)) -> Result<(), String> {
        let start = self.check(block)?;
        let before = self.before.expect("checked");
        if before.pass_idx < 0 {
            self.pass_idx += 1;
        }
        let piece = block.piece();
        let duration_s = piece.duration_s();
        let end = block.end_mm;
        let pass_idx = self.pass_idx;
        self.ticks(duration_s, |time_s, t| {
            let m = t / duration_s;
            // x - e/pi sin(pi x) = t/T
            let x = piece.progress(m);
            let (position_mm, feed_mm_per_s) = match block.corner_mm {
                None => (
                    [0, 1].map(|a| start[a] + (end[a] - start[a]) * x),
                    1.0 / piece.density_s_per_mm_at(x),
                ),
                Some(corner) => {
                    let y = 1.0 - m;
                    let position =
                        [0, 1].map(|a| y * y * start[a] + 2.0 * m * y * corner[a] + m * m * end[a]);
                    let [u, v] = [0, 1].map(|a| {
                        2.0 * (y * (corner[a] - start[a]) + m * (end[a] - corner[a])) / duration_s
                    });
                    (position, u.hypot(v))
                }
            };
            emit(Reference { time_s, position_mm, feed_mm_per_s, pass_idx });
        });
        self.before = Some(Before {
            point_mm: end,
            velocity_mm_per_s: block.end_velocity(start),
            arc_length_mm: block.arc_length_mm[1],
            pass_idx,
            has_moved: true,
            in_pass: true,
        });
        Ok(())
    }

    /// Emits the references of a cubic record.
    fn link(&mut self, cubic: &Cubic, mut emit: impl FnMut(Reference)) -> Result<(), String> {
        let Some(before) = self.before else {
            return Err("a cubic stands before the start; begin with N X Y Z S".into());
        };
        let duration_s = cubic.duration_s;
        let c = [0, 1].map(|a| {
            let p = before.point_mm[a];
            let v = before.velocity_mm_per_s[a];
            let w = cubic.velocity_mm_per_s[a];
            hermite::coefficients(p, cubic.end_mm[a] - p, v, w, duration_s)
        });
        let pass_idx = if cubic.tool_on { self.pass_idx.max(0) } else { -1 };
        self.ticks(duration_s, |time_s, t| {
            let [(x, u), (y, v)] = c.each_ref().map(|c| end_of(c, t));
            emit(Reference { time_s, position_mm: [x, y], feed_mm_per_s: u.hypot(v), pass_idx });
        });
        self.before = Some(Before {
            point_mm: cubic.end_mm,
            velocity_mm_per_s: cubic.velocity_mm_per_s,
            pass_idx,
            has_moved: true,
            in_pass: false,
            ..before
        });
        Ok(())
    }

    /// Calls `emit` for every tick within the next `duration_s`, and advances the time by `duration_s`. `emit` gets the
    /// time since the start of the program and the time since the start of the record, s.
    fn ticks(&mut self, duration_s: f64, mut emit: impl FnMut(f64, f64)) {
        loop {
            let time_s = self.tick as f64 * self.tick_s;
            let t = time_s - self.start_s;
            if t >= duration_s {
                break;
            }
            emit(time_s, t.max(0.0));
            self.tick += 1;
        }
        let add = duration_s - self.lost_s;
        let sum = self.start_s + add;
        self.lost_s = (sum - self.start_s) - add;
        self.start_s = sum;
    }

    /// Returns the start point of the block, mm; an error if its arc lengths, densities or points contradict each other
    /// or the record before.
    fn check(&self, block: &Block) -> Result<[f64; 2], String> {
        let Some(Before { point_mm: start, arc_length_mm: s, .. }) =
            self.before.filter(|b| b.in_pass)
        else {
            return Err("a block stands before the start of a pass; begin with N X Y Z S".into());
        };
        let [s1, s2] = block.arc_length_mm;
        if (s1 - s).abs() > SAME_LENGTH_MM {
            return Err(format!("the block starts at {s1} mm, the one before ended at {s} mm"));
        }
        if s2 <= s1 {
            return Err(format!("the block goes from {s1} to {s2} mm; arc lengths ascend"));
        }
        if let Some(d) = block.density_s_per_mm.iter().find(|d| **d <= 0.0) {
            return Err(format!("a density is {d} s/mm; give the inverse of a feedrate"));
        }
        let length = match block.corner_mm {
            None => distance(start, block.end_mm),
            Some(corner) => {
                if block.density_s_per_mm[0] != block.density_s_per_mm[1] {
                    return Err("a blend has two densities; it is run at a constant one".into());
                }
                distance(start, corner) + distance(corner, block.end_mm)
            }
        };
        if (length - (s2 - s1)).abs() > SAME_LENGTH_MM {
            return Err(format!(
                "the block is {} mm long by its arc lengths, {length} mm by its points",
                s2 - s1
            ));
        }
        Ok(start)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn density() -> DwellDensity {
        let s = vec![0.0, 1.0, 1.9, 2.0, 2.1, 3.0, 8.0, 9.0];
        let d = vec![0.1, 0.1, 0.3, 0.3, 0.3, 0.2, 0.5, 0.4];
        let p = vec![
            [0.0, 0.0],
            [1.0, 0.0],
            [1.9, 0.0],
            [2.0, 0.0],
            [2.0, 0.1],
            [2.0, 1.0],
            [2.0, 1.0],
            [2.0, 2.0],
        ];
        let corner = (0..8).map(|i| i == 3).collect();
        let nodes = planish_types::DensityNodes {
            arc_length_mm: s,
            dwell_density_s_per_mm: d,
            point_mm: p,
            pass_idx: vec![0, 0, 0, 0, 0, 0, 1, 1],
            corner,
        };
        DwellDensity::new(nodes).unwrap()
    }

    #[test]
    fn a_program_is_read_as_it_was_written() {
        let records: Vec<Record> = records(&density()).collect();
        assert_eq!(records.len(), 7);
        for (i, record) in records.iter().enumerate() {
            assert_eq!(Record::parse(&record.to_line(i, 0.0)).unwrap(), Some(*record));
        }
        assert_eq!(records[0].to_line(0, 0.0), "N00000 X0 Y0 Z0 S0");
        assert_eq!(records[1].to_line(1, 0.0), "N00001 X1 Y0 Z0 P0.1 Q0.1 R0 S1");
        assert_eq!(records[3].to_line(3, 0.0), "N00003 X2 Y0.1 Z0 I2 J0 P0.3 Q0.3 R1.9 S2.1");
        let third = Record::Start { point_mm: [1.0 / 3.0, -2e-7], arc_length_mm: 1e6 / 7.0 };
        assert_eq!(Record::parse(&third.to_line(2, -1.25)).unwrap(), Some(third));
        let cubic = Cubic {
            end_mm: [1.0 / 3.0, -2.0],
            velocity_mm_per_s: [-1.5, 0.0],
            duration_s: 0.75,
            tool_on: false,
        };
        let line = Record::Cubic(cubic).to_line(3, 0.0);
        assert_eq!(line, "N00003 X0.3333333333333333 Y-2 Z0 U-1.5 V0 T0.75 K0");
        assert_eq!(Record::parse(&line).unwrap(), Some(Record::Cubic(cubic)));
        assert_eq!(Record::parse("  ").unwrap(), None);
        assert_eq!(Record::parse("(units: mm)").unwrap(), None);
    }

    #[test]
    fn bad_lines_are_refused() {
        let error = |line: &str| Record::parse(line).unwrap_err();
        assert!(error("N1 Xone Y2 S3").contains("\"Xone\""));
        assert!(error("N1 X1 Y2 F3 S3").contains("\"F3\""));
        assert!(error("N1 X1 YNaN S3").contains("\"YNaN\""));
        assert!(error("N1 X1 X2 Y2 S3").contains("X stands twice"));
        assert!(error("N1 X1 S3").contains("Y is missing"));
        assert!(error("N1 X1 Y1 P1 R0 S3").contains("Q is missing"));
        assert!(error("N1 X1 Y1 I1 P1 Q1 R0 S3").contains("I and J"));
        assert!(error("N1 X1 Y1 U0 V0 T1").contains("K is missing"));
        assert!(error("N1 X1 Y1 U0 V0 T0 K0").contains("T is 0 s"));
        assert!(error("N1 X1 Y1 U0 V0 T1 K2").contains("K is 2"));
        assert!(error("N1 X1 Y1 U0 V0 T1 K0 S1").contains("S does not stand beside"));
        assert!(error("\u{3c0}1").contains("not one of"));
    }

    #[test]
    fn blocks_that_do_not_join_are_refused() {
        let block = |line: &str| {
            let mut i = Interpolator::new(1e-3).unwrap();
            let start = Record::Start { point_mm: [0.0; 2], arc_length_mm: 5.0 };
            i.push(&start, |_| {}).unwrap();
            i.push(&Record::parse(line).unwrap().unwrap(), |_| {}).unwrap_err()
        };
        let mut i = Interpolator::new(1e-3).unwrap();
        let mut push = |line: &str| i.push(&Record::parse(line).unwrap().unwrap(), |_| {});
        push("X0 Y0 S0").unwrap();
        push("X1 Y0 P1 Q1 R0 S1").unwrap();
        let said = push("X3 Y0 S0").unwrap_err();
        assert!(said.contains("the tool is at [1.0, 0.0] mm") && said.contains("`trajectory`"));
        push("X3 Y0 U0 V0 T2 K0").unwrap();
        assert!(push("X4 Y0 P1 Q1 R1 S2").unwrap_err().contains("before the start of a pass"));
        push("X3 Y0 S0").unwrap();
        push("X4 Y0 P1 Q1 R0 S1").unwrap();
        assert!(block("X1 Y0 P1 Q1 R4 S5").contains("the one before ended at 5 mm"));
        assert!(block("X1 Y0 P1 Q1 R5 S5").contains("ascend"));
        assert!(block("X1 Y0 P1 Q0 R5 S6").contains("0 s/mm"));
        assert!(block("X1 Y1 P1 Q1 R5 S6").contains("by its points"));
        assert!(block("X1 Y1 I1 J0 P1 Q2 R5 S7").contains("constant"));
        let mut i = Interpolator::new(1e-3).unwrap();
        let first = Record::parse("X1 Y1 P1 Q1 R5 S6").unwrap().unwrap();
        assert!(i.push(&first, |_| {}).unwrap_err().contains("before the start"));
        assert!(Interpolator::new(0.0).is_err() && Interpolator::new(f64::NAN).is_err());
    }

    #[test]
    fn ticks_are_equal_in_time_and_the_last_is_the_end() {
        let tick_s = 0.01;
        let mut i = Interpolator::new(tick_s).unwrap();
        let mut found = Vec::new();
        for record in records(&density()) {
            i.push(&record, |r| found.push(r)).unwrap();
        }
        found.extend(i.finish());
        // 0.1 + 0.9 * 0.2 + 0.2 * 0.3 + 0.9 * 0.25 + 0.45 s
        let total = 1.015;
        let last = found.last().unwrap();
        assert!((last.time_s - total).abs() < 1e-12 && last.position_mm == [2.0, 2.0], "{last:?}");
        assert_eq!(found.len(), 103);
        for (k, r) in found[..102].iter().enumerate() {
            assert!((r.time_s - tick_s * k as f64).abs() < 1e-15);
        }
        // Constant density: 10 mm/s.
        assert!((found[5].position_mm[0] - 0.5).abs() < 1e-12);
        assert_eq!(found[5].pass_idx, 0);
        assert_eq!(found[102].pass_idx, 1);
        // Middle of the blend, from 0.28 s to 0.34 s: (P1 + 2 C + P2) / 4.
        let middle = found[31].position_mm;
        assert!((middle[0] - 1.975).abs() + (middle[1] - 0.025).abs() < 1e-12, "{middle:?}");
    }

    #[test]
    fn the_feed_is_that_of_the_positions_on_lines_and_on_blends() {
        let tick_s = 1e-4;
        let mut i = Interpolator::new(tick_s).unwrap();
        let mut found = Vec::new();
        for record in records(&density()) {
            i.push(&record, |r| found.push(r)).unwrap();
        }
        for three in found.windows(3).filter(|r| r[0].pass_idx == r[2].pass_idx) {
            let [a, b] = [0, 2].map(|k| three[k].position_mm);
            let measured = (b[0] - a[0]).hypot(b[1] - a[1]) / (2.0 * tick_s);
            // The parabola begins and ends with a step of the acceleration, of 79 mm/s^2: half a tick of it.
            assert!((measured - three[1].feed_mm_per_s).abs() < 0.01, "{measured} {three:?}");
        }
        // Half-way around a corner of 90 degrees the tool is at (u1 + u2)/2 of its feed, 1/0.3 mm/s.
        let middle = found[3100];
        assert!((middle.feed_mm_per_s - 0.5_f64.sqrt() / 0.3).abs() < 1e-9, "{middle:?}");
    }
}
