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

use planish_types::Invalid;

use crate::table::Table;

/// Beyond this a float has no whole numbers between its neighbours.
const MOST: f64 = 9_007_199_254_740_992.0;

/// What is rounded to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quanta {
    /// Size of a count of (x, y), mm.
    pub count_mm: [f64; 2],
    /// A tick, s.
    pub tick_s: f64,
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
    /// Velocity [x, y] (n+1), mm/s; not rounded.
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
    for c in quanta.count_mm {
        crate::positive("count_mm", c)?;
    }
    let whole = |name: &'static str, k: usize, v: f64| match v.round() {
        r if r.abs() < MOST => Ok(r as i64),
        r => {
            let remedy = "give a larger count or tick";
            Err(Invalid::at(name, k, format!("is {r:e} counts or ticks"), remedy))
        }
    };
    let mut q = Quantised {
        quanta: *quanta,
        ticks: Vec::with_capacity(table.time_s.len()),
        counts: Vec::with_capacity(table.time_s.len()),
        velocity_mm_per_s: table.velocity_mm_per_s.clone(),
        tool_on: table.tool_on.clone(),
        rounding_mm: [0.0; 2],
        rounding_s: 0.0,
    };
    for (k, (t, p)) in table.time_s.iter().zip(&table.position_mm).enumerate() {
        // N = round(t / tick), P = round(p / count)
        q.ticks.push(whole("time_s", k, t / quanta.tick_s)?);
        q.counts.push([
            whole("position_mm", k, p[0] / quanta.count_mm[0])?,
            whole("position_mm", k, p[1] / quanta.count_mm[1])?,
        ]);
        q.rounding_s = q.rounding_s.max((q.time_s(k) - t).abs());
        for a in 0..2 {
            q.rounding_mm[a] = q.rounding_mm[a].max((q.position_mm(k)[a] - p[a]).abs());
        }
    }
    for k in 0..q.tool_on.len() {
        let n = q.duration(k);
        if !(ticks[0]..=ticks[1]).contains(&n) {
            let lasts = table.time_s[k + 1] - table.time_s[k];
            let problem = format!(
                "lasts {lasts} s, {n} ticks of {} s; the controller takes {} to {}",
                quanta.tick_s, ticks[0], ticks[1]
            );
            return Err(Invalid::at("segment", k, problem, "plan longer dwell times"));
        }
    }
    Ok(q)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A thousand steps of 1/3 count in 1/3 tick more than one.
    fn table(n: usize, count: f64, tick: f64) -> Table {
        Table {
            time_s: (0..=n).map(|k| k as f64 * tick * (4.0 / 3.0)).collect(),
            position_mm: (0..=n)
                .map(|k| [k as f64 * count / 3.0, -(k as f64) * count / 7.0])
                .collect(),
            velocity_mm_per_s: vec![[0.0; 2]; n + 1],
            tool_on: vec![true; n],
        }
    }

    #[test]
    fn the_remainder_is_carried_and_nothing_drifts() {
        let (n, count, tick) = (1000, 1e-4, 1e-3);
        let quanta = Quanta { count_mm: [count; 2], tick_s: tick };
        let q = quantise(&table(n, count, tick), &quanta, [1, 100]).unwrap();
        let sum: i64 = (0..n).map(|k| q.distance(k)[0]).sum();
        // 1000/3 and 1000/7 counts, 4000/3 ticks: rounded one by one they would be 0, 0 and 1000.
        assert_eq!((sum, q.counts[n], q.ticks[n]), (333, [333, -143], 1333));
        assert!(q.rounding_mm.iter().all(|r| *r <= 0.5 * count * (1.0 + 1e-9)));
        assert!(q.rounding_s <= 0.5 * tick * (1.0 + 1e-9));
    }

    #[test]
    fn what_a_controller_cannot_count_is_refused() {
        let quanta = Quanta { count_mm: [1e-4; 2], tick_s: 1e-3 };
        let message = |quanta: &Quanta, ticks| {
            quantise(&table(10, 1e-4, 1e-3), quanta, ticks).unwrap_err().to_string()
        };
        assert!(message(&quanta, [2, 100]).contains("segment[0]: lasts 0.00133"));
        let zero = Quanta { count_mm: [0.0, 1.0], ..quanta };
        assert!(message(&zero, [1, 100]).contains("count_mm: is 0"));
        let tiny = Quanta { count_mm: [1e-30; 2], ..quanta };
        assert!(message(&tiny, [1, 100]).contains("larger count"));
    }
}
