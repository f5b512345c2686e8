//! Whole counts and whole ticks.
//!
//! ```text
//! P_k = round(p_k / count),   N_k = round(t_k / tick)
//! dP_k = P_k - P_(k-1),       T_k = N_k - N_(k-1)
//! ```
//!
//! Absolute positions and times are rounded, and what is sent are their differences: the remainder of
//! a segment is carried into the next. So every end is within half a count and half a tick of the
//! plan, and the sums of the differences are exact. A time is not changed without its position: the
//! path keeps its ends.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | P | `counts` | counts |
//! | N | `ticks` | ticks |
//!
//! Ends that fall on one tick become one, the last of them (the first, at the start): a ramp that is shorter
//! than a tick goes into the segment after it.
//!
//! The velocities at the ends are rounded to what the controller takes; the first and the last are
//! zero, as the machine rests before and after.

use planish_types::Invalid;

use crate::table::Table;

/// Beyond this a float has no whole numbers between its neighbours.
const LARGEST_EXACT_INTEGER: f64 = 9_007_199_254_740_992.0;

/// Positions are written with nine decimals.
const SMALLEST_COUNT_MM: f64 = 1e-9;

/// What is rounded to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quanta {
    /// Size of a count of (x, y), mm.
    pub count_mm: [f64; 2],
    /// A tick, s.
    pub tick_s: f64,
    /// Unit of the velocity of (x, y), mm/s.
    pub velocity_mm_per_s: [f64; 2],
}

/// A table in counts and ticks.
#[derive(Clone, Debug)]
pub struct Quantised {
    /// What was rounded to.
    pub quanta: Quanta,
    /// Ticks since the start (n+1).
    pub ticks: Vec<i64>,
    /// Absolute position of (x, y) in counts (n+1).
    pub counts: Vec<[i64; 2]>,
    /// Velocity [x, y] (n+1), mm/s; rounded.
    pub velocity_mm_per_s: Vec<[f64; 2]>,
    /// Whether the tool removes (n).
    pub tool_on: Vec<bool>,
    /// Largest |position - counts| of (x, y), mm.
    pub rounding_mm: [f64; 2],
    /// Largest |time - ticks|, s.
    pub rounding_s: f64,
}

impl Quantised {
    /// Position [x, y] of end `k`, mm.
    pub fn position_mm(&self, k: usize) -> [f64; 2] {
        [0, 1].map(|a| self.counts[k][a] as f64 * self.quanta.count_mm[a])
    }

    /// Time of end `k` since the start, s.
    pub fn time_s(&self, k: usize) -> f64 {
        self.ticks[k] as f64 * self.quanta.tick_s
    }

    /// Distance of segment `k` in counts.
    pub fn distance(&self, k: usize) -> [i64; 2] {
        [0, 1].map(|a| self.counts[k + 1][a] - self.counts[k][a])
    }

    /// Ticks of segment `k`.
    pub fn duration(&self, k: usize) -> i64 {
        self.ticks[k + 1] - self.ticks[k]
    }
}

/// Rounds `table`; every segment must have from `ticks[0]` to `ticks[1]` ticks.
pub fn quantise(table: &Table, quanta: &Quanta, ticks: [i64; 2]) -> Result<Quantised, Invalid> {
    let extent_mm = table.extent_mm();
    for c in quanta.count_mm {
        crate::positive("count_mm", c)?;
        let remedy = "give the size of an encoder count in mm";
        if c < SMALLEST_COUNT_MM {
            let problem = format!("is {c}, a program has nine decimals of a mm");
            return Err(Invalid::whole("count_mm", problem, remedy));
        }
        if c > extent_mm && extent_mm > 0.0 {
            let problem = format!("is {c}, the whole motion goes {extent_mm} mm");
            return Err(Invalid::whole("count_mm", problem, remedy));
        }
    }
    let whole = |name: &'static str, k: usize, v: f64| match v.round() {
        r if r.abs() < LARGEST_EXACT_INTEGER => Ok(r as i64),
        r => {
            let remedy = "give a larger count or tick";
            Err(Invalid::at(name, k, format!("is {r:e} counts or ticks"), remedy))
        }
    };
    let mut q = Quantised {
        quanta: *quanta,
        ticks: Vec::with_capacity(table.time_s.len()),
        counts: Vec::with_capacity(table.time_s.len()),
        velocity_mm_per_s: Vec::with_capacity(table.time_s.len()),
        tool_on: Vec::with_capacity(table.tool_on.len()),
        rounding_mm: [0.0; 2],
        rounding_s: 0.0,
    };
    let n = table.tool_on.len();
    // The end of the table that every end of the program is.
    let mut source = Vec::with_capacity(n + 1);
    for (k, (t, p)) in table.time_s.iter().zip(&table.position_mm).enumerate() {
        // N = round(t / tick), P = round(p / count)
        let ticks = whole("time_s", k, t / quanta.tick_s)?;
        let counts = [
            whole("position_mm", k, p[0] / quanta.count_mm[0])?,
            whole("position_mm", k, p[1] / quanta.count_mm[1])?,
        ];
        let velocity = [0, 1].map(|a| {
            let unit = quanta.velocity_mm_per_s[a];
            (table.velocity_mm_per_s[k][a] / unit).round() * unit
        });
        let same_tick = q.ticks.last() == Some(&ticks);
        if same_tick {
            q.tool_on.pop();
        }
        // The start keeps its place.
        if same_tick && source.len() > 1 {
            source.pop();
            q.ticks.pop();
            q.counts.pop();
            q.velocity_mm_per_s.pop();
        }
        if q.ticks.last() != Some(&ticks) {
            source.push(k);
            q.ticks.push(ticks);
            q.counts.push(counts);
            q.velocity_mm_per_s.push(velocity);
        }
        if k < n {
            q.tool_on.push(table.tool_on[k]);
        }
        q.rounding_s = q.rounding_s.max((ticks as f64 * quanta.tick_s - t).abs());
        for a in 0..2 {
            let rounded_mm = counts[a] as f64 * quanta.count_mm[a];
            q.rounding_mm[a] = q.rounding_mm[a].max((rounded_mm - p[a]).abs());
        }
    }
    let last = source.len() - 1;
    if last == 0 {
        let problem = format!(
            "the whole motion lasts {} s, not one tick of {} s",
            table.time_s[n], quanta.tick_s
        );
        return Err(Invalid::whole("time_s", problem, "give a smaller tick"));
    }
    (q.velocity_mm_per_s[0], q.velocity_mm_per_s[last]) = ([0.0; 2], [0.0; 2]);
    for k in 0..q.tool_on.len() {
        let n = q.duration(k);
        if !(ticks[0]..=ticks[1]).contains(&n) {
            let lasts = table.time_s[source[k + 1]] - table.time_s[source[k]];
            let problem = format!(
                "lasts {lasts} s, {n} ticks of {} s; the controller takes {} to {}",
                quanta.tick_s, ticks[0], ticks[1]
            );
            let remedy = "give a smaller tick, or plan longer dwell times";
            return Err(Invalid::at("segment", k, problem, remedy));
        }
    }
    Ok(q)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quanta(count_mm: f64, tick_s: f64) -> Quanta {
        Quanta { count_mm: [count_mm; 2], tick_s, velocity_mm_per_s: [1e-9; 2] }
    }

    /// A thousand steps of 1/3 count in 1/3 tick more than one.
    fn table(n: usize, count: f64, tick: f64) -> Table {
        Table {
            time_s: (0..=n).map(|k| k as f64 * tick * (4.0 / 3.0)).collect(),
            position_mm: (0..=n)
                .map(|k| [k as f64 * count / 3.0, -(k as f64) * count / 7.0])
                .collect(),
            velocity_mm_per_s: vec![[0.0; 2]; n + 1],
            tool_on: vec![true; n],
            from_straight_mm: 0.0,
        }
    }

    #[test]
    fn the_remainder_is_carried_and_nothing_drifts() {
        let (n, count, tick) = (1000, 1e-4, 1e-3);
        let quanta = quanta(count, tick);
        let q = quantise(&table(n, count, tick), &quanta, [1, 100]).unwrap();
        let sum: i64 = (0..n).map(|k| q.distance(k)[0]).sum();
        // 1000/3 and 1000/7 counts, 4000/3 ticks: rounded one by one they would be 0, 0 and 1000.
        assert_eq!((sum, q.counts[n], q.ticks[n]), (333, [333, -143], 1333));
        assert!(q.rounding_mm.iter().all(|r| *r <= 0.5 * count * (1.0 + 1e-9)));
        assert!(q.rounding_s <= 0.5 * tick * (1.0 + 1e-9));
    }

    #[test]
    fn ends_on_one_tick_become_one() {
        let table = Table {
            time_s: vec![0.0, 0.1e-3, 10e-3, 10.1e-3, 20e-3, 20.2e-3],
            position_mm: [0.0, 0.01, 1.0, 1.01, 2.0, 2.02].map(|x| [x, 0.0]).to_vec(),
            velocity_mm_per_s: [0.0, 100.0, 100.0, 90.0, 100.0, 0.0].map(|v| [v, 0.0]).to_vec(),
            tool_on: vec![true, false, true, false, true],
            from_straight_mm: 0.0,
        };
        let q = quantise(&table, &quanta(1e-3, 1e-3), [1, 100]).unwrap();
        assert_eq!(q.ticks, [0, 10, 20]);
        assert_eq!(q.counts, [[0, 0], [1010, 0], [2020, 0]]);
        assert_eq!(q.velocity_mm_per_s, [[0.0; 2], [90.0, 0.0], [0.0; 2]]);
        // Those of the segments that last.
        assert_eq!(q.tool_on, [false, false]);
        let said = quantise(&table, &quanta(1e-3, 1.0), [1, 100]).unwrap_err().to_string();
        assert!(said.contains("the whole motion lasts 0.0202 s, not one tick of 1 s"), "{said}");
    }

    #[test]
    fn what_a_controller_cannot_count_is_refused() {
        let quanta = quanta(1e-4, 1e-3);
        let message = |quanta: &Quanta, ticks| {
            quantise(&table(10, 1e-4, 1e-3), quanta, ticks).unwrap_err().to_string()
        };
        assert!(message(&quanta, [2, 100]).contains("segment[0]: lasts 0.00133"));
        let zero = Quanta { count_mm: [0.0, 1e-4], ..quanta };
        assert!(message(&zero, [1, 100]).contains("count_mm: is 0"));
        let tiny = Quanta { count_mm: [1e-30; 2], ..quanta };
        assert!(message(&tiny, [1, 100]).contains("nine decimals"));
        // The motion goes 10/3 counts.
        let huge = Quanta { count_mm: [1e-4, 1e-3], ..quanta };
        assert!(message(&huge, [1, 100]).contains("the whole motion goes 0.00033"));
        let quick = Quanta { tick_s: 1e-19, ..quanta };
        assert!(message(&quick, [1, 100]).contains("larger count or tick"));
    }
}
