//! A hidden controller, made here from its rules by small steps of time, and what a noisy log shows of it.

use planish_reconcile::controller::identify;
use planish_testkit::case_generator;
use planish_types::{Trajectory, TrajectoryBuilder};
use rand::RngExt;

/// Rules of a controller that this test makes.
struct Hidden {
    lag_s: f64,
    smoothing_s: f64,
    /// Change of the velocity that a corner lets pass, mm/s.
    corner_mm_per_s: f64,
    acceleration_mm_per_s2: f64,
    /// Seconds of the log per second of the controller.
    clock: f64,
}

const SPEED_MM_PER_S: f64 = 20.0;
/// Step of the simulation, s. The error of the average and of the lag is of its square: 1e-6 of an acceleration of 1e3.
const STEP_S: f64 = 5e-5;
/// Time for which the log runs before the program, s; no multiple of a sample.
const BEFORE_S: f64 = 0.731_3;
const RATE_HZ: f64 = 1000.0;

const TURNS: [f64; 16] =
    [0.4, 2.2, 0.9, 3.0, 1.4, 2.6, 0.2, 1.9, 2.9, 0.7, 1.2, 2.4, 3.1, 0.5, 1.7, 2.1];

/// 48 lines of 10 mm with turns of many angles, which stay near the origin.
fn corners() -> Vec<[f64; 2]> {
    let mut heading: f64 = 0.3;
    let mut points = vec![[0.0, 0.0]];
    for turn in TURNS.iter().cycle().take(48) {
        let [x, y] = points[points.len() - 1];
        points.push([x + 10.0 * heading.cos(), y + 10.0 * heading.sin()]);
        heading += turn;
    }
    points
}

/// The commanded motion: every line at one speed.
fn command(points: &[[f64; 2]]) -> Trajectory {
    let mut builder = TrajectoryBuilder::default();
    for w in points.windows(2) {
        let seconds = (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1]) / SPEED_MM_PER_S;
        let line = |a: usize| [w[0][a], (w[1][a] - w[0][a]) / seconds, 0.0, 0.0];
        builder.push(seconds, [line(0), line(1)], true, None);
    }
    builder.build().unwrap()
}

impl Hidden {
    /// Returns the speed that a corner lets pass, mm/s: `d / (2 sin(b / 2))` for a turn by b, and d at both ends.
    fn corner_speed(&self, points: &[[f64; 2]], k: usize) -> f64 {
        if k == 0 || k + 1 == points.len() {
            return self.corner_mm_per_s.min(SPEED_MM_PER_S);
        }
        let heading = |i: usize| {
            let [from, to] = [points[i], points[i + 1]];
            (to[1] - from[1]).atan2(to[0] - from[0])
        };
        let turn = heading(k) - heading(k - 1);
        (self.corner_mm_per_s / (2.0 * (0.5 * turn).sin().abs())).min(SPEED_MM_PER_S)
    }

    /// Returns the positions of the planner before smoothing, at steps of time from the start.
    fn planned(&self, points: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let n = points.len();
        let a = self.acceleration_mm_per_s2;
        let mut speed: Vec<f64> = (0..n).map(|k| self.corner_speed(points, k)).collect();
        let length: Vec<f64> =
            points.windows(2).map(|w| (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1])).collect();
        for k in 1..n {
            speed[k] = speed[k].min((speed[k - 1].powi(2) + 2.0 * a * length[k - 1]).sqrt());
        }
        for k in (0..n - 1).rev() {
            speed[k] = speed[k].min((speed[k + 1].powi(2) + 2.0 * a * length[k]).sqrt());
        }
        let mut positions = Vec::new();
        let mut carry_s = 0.0;
        for k in 0..n - 1 {
            // Up, at full speed, down
            let top = (0.5 * (speed[k].powi(2) + speed[k + 1].powi(2)) + a * length[k])
                .sqrt()
                .min(SPEED_MM_PER_S);
            let up_s = (top - speed[k]) / a;
            let down_s = (top - speed[k + 1]) / a;
            let ramps = 0.5 * (speed[k] + top) * up_s + 0.5 * (top + speed[k + 1]) * down_s;
            let full_s = (length[k] - ramps) / top;
            let total_s = up_s + full_s + down_s;
            let mut t = carry_s;
            while t < total_s {
                let s = if t < up_s {
                    speed[k] * t + 0.5 * a * t * t
                } else if t < up_s + full_s {
                    0.5 * (speed[k] + top) * up_s + top * (t - up_s)
                } else {
                    let left = total_s - t;
                    length[k] - speed[k + 1] * left - 0.5 * a * left * left
                };
                let f = s / length[k];
                positions
                    .push([0, 1].map(|i| points[k][i] + f * (points[k + 1][i] - points[k][i])));
                t += STEP_S;
            }
            carry_s = t - total_s;
        }
        positions
    }

    /// Returns the log: positions with noise of this size from before the motion to after it.
    fn log(&self, points: &[[f64; 2]], noise_mm: f64) -> Trajectory {
        let planned = self.planned(points);
        let window = (self.smoothing_s / STEP_S).round() as usize;
        let rest = (0.5 / STEP_S) as usize;
        let command = |k: isize| planned[k.clamp(0, planned.len() as isize - 1) as usize];
        let mut positions = Vec::new();
        let mut axis = planned[0];
        let decay = (-STEP_S / self.lag_s).exp();
        let mut before = planned[0];
        for k in 0..planned.len() + window + rest {
            // The average by the trapezoidal rule
            let mut average = [0.0; 2];
            for i in 0..=window {
                let weight = if i == 0 || i == window { 0.5 } else { 1.0 };
                let r = command(k as isize - i as isize);
                average.iter_mut().zip(r).for_each(|(q, r)| *q += weight * r / window as f64);
            }
            // tau q' = r - q for the mean of the command over the step
            for a in 0..2 {
                let r = 0.5 * (before[a] + average[a]);
                axis[a] = r + decay * (axis[a] - r);
            }
            before = average;
            positions.push(axis);
        }
        self.sampled(&positions, noise_mm)
    }

    fn sampled(&self, positions: &[[f64; 2]], noise_mm: f64) -> Trajectory {
        let mut random = case_generator(67, 0, 0);
        let mut normal = || (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
        let total_s = positions.len() as f64 * STEP_S * self.clock + BEFORE_S - 0.1;
        let count = (total_s * RATE_HZ) as usize;
        let mut samples = Vec::with_capacity(count);
        for i in 0..count {
            let t = (i as f64 / RATE_HZ - BEFORE_S) / self.clock / STEP_S;
            let k = t.max(0.0) as usize;
            let f = t.max(0.0) - k as f64;
            let [p, q] = [positions[k], positions[k + 1]];
            samples.push([0, 1].map(|a| p[a] + f * (q[a] - p[a]) + noise_mm * normal()));
        }
        let times = (0..count).map(|i| i as f64 / RATE_HZ).collect();
        let lines = samples
            .windows(2)
            .map(|w| [0, 1].map(|a| [w[0][a], (w[1][a] - w[0][a]) * RATE_HZ, 0.0, 0.0]));
        let lines: Vec<[[f64; 4]; 2]> = lines.collect();
        let n = lines.len();
        Trajectory::new(times, lines, vec![true; n], vec![None; n]).unwrap()
    }
}

/// Noise of 1 um at 1 kHz, lines of half a second: every property within 2 %, and within five standard errors.
#[test]
fn one_noisy_log_shows_lag_smoothing_corners_and_clock() {
    let hidden = Hidden {
        lag_s: 0.008,
        smoothing_s: 0.02,
        corner_mm_per_s: 4.0,
        acceleration_mm_per_s2: 400.0,
        clock: 1.0002,
    };
    let points = corners();
    let found = identify(&hidden.log(&points, 1e-3), &command(&points)).unwrap();
    let values = [
        ("lag", found.lag_s, hidden.lag_s),
        ("smoothing", found.smoothing_s, hidden.smoothing_s),
        ("corner", found.corner_mm_per_s, hidden.corner_mm_per_s),
        ("acceleration", found.acceleration_mm_per_s2, hidden.acceleration_mm_per_s2),
        ("clock", found.clock, hidden.clock - 1.0),
    ];
    for (name, value, truth) in values {
        let value = value.unwrap_or_else(|| panic!("{name} is not determined"));
        println!("{name}: {:.6} +- {:.1e} for {truth}", value.value, value.standard_error);
        // The clock is known to a part of a sample over the whole log.
        let allowed = if name == "clock" { 2e-5 } else { 0.02 * truth };
        assert!((value.value - truth).abs() < allowed, "{name}: {value:?} for {truth}");
    }
    // The program begins BEFORE_S after the first sample, but for half a step of the simulation.
    assert!((found.begins_s.value - BEFORE_S).abs() < 2e-4, "{:?}", found.begins_s);
    // The noise of 12 uniform numbers is that of one normal one; its median has 1 % over 26 000 values.
    assert!((found.noise_mm / 1e-3 - 1.0).abs() < 0.03, "{}", found.noise_mm);
    assert_eq!(found.drawback(), None);
    let budget = found.error_budget().unwrap().checked().unwrap();
    assert_eq!(budget.errors.len(), 4);
}

/// A log of a machine whose axis x has a stiction of 20 um is no lag, smoothing or corner: the fit says so.
#[test]
fn a_controller_of_other_rules_is_not_taken_for_one_of_these() {
    let hidden = Hidden {
        lag_s: 0.008,
        smoothing_s: 0.02,
        corner_mm_per_s: 4.0,
        acceleration_mm_per_s2: 400.0,
        clock: 1.0,
    };
    let points = corners();
    let log = hidden.log(&points, 1e-3);
    let stuck = log.coefficient_mm().iter().map(|c| {
        let x = (c[0][0] / 0.02).round() * 0.02;
        [[x, 0.0, 0.0, 0.0], c[1]]
    });
    let n = log.len();
    let stuck =
        Trajectory::new(log.break_time_s().to_vec(), stuck.collect(), vec![true; n], vec![None; n]);
    let found = identify(&stuck.unwrap(), &command(&points)).unwrap();
    let drawback = found.drawback().unwrap();
    assert!(drawback.contains("does more than to lag"), "{drawback}");
}

#[test]
fn a_log_of_another_place_or_without_its_beginning_is_refused() {
    let hidden = Hidden {
        lag_s: 0.008,
        smoothing_s: 0.02,
        corner_mm_per_s: 4.0,
        acceleration_mm_per_s2: 400.0,
        clock: 1.0,
    };
    let points = corners();
    let log = hidden.log(&points, 0.0);
    let moved: Vec<[f64; 2]> = points.iter().map(|p| [p[0] + 5.0, p[1]]).collect();
    let message = identify(&log, &command(&moved)).unwrap_err().to_string();
    assert!(message.contains("does not begin at rest within"), "{message}");
}
