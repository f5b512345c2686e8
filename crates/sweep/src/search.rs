//! Search for better plans: proposes new ones between neighbours on the front of residual against time.
//!
//! Between two neighbours on the front of residual against time, a plan is proposed with the settings half way: the
//! geometric mean of numbers above 0, as pitches, floors and prices are compared by ratios. Where the neighbours have
//! another path, method or word, each is proposed with the numbers half way to the other. The search ends when the area
//! that the front dominates ([`dominated_area`]) has grown by less than a stated part in a round.

use std::collections::BTreeSet;

use planish_numerics::pareto::{dominated_area, front};
use planish_types::outcome::sweep::SettingValue;

use crate::{
    plan::{Ground, SweptPlan},
    setting::SETTINGS,
};

/// Position of the corner of the area over the largest value on the front, so that the ends of the front count.
/// A larger ratio: the ends of the front decide the area. A smaller one: plans at the ends add nothing to the area.
const BEYOND: f64 = 1.1;

/// A plan that was made, with the two coordinates of its point: time and residual.
pub type Made<'a> = (&'a SweptPlan, [f64; 2]);

/// Proposes the plans to try next: two between each pair of neighbours on the front. `made` are the plans that can be
/// on the front, and `all` those that exist and are not proposed again. `ground` holds the hashes of the inputs that
/// all plans share.
pub fn proposals(made: &[Made<'_>], all: &[&SweptPlan], ground: &Ground) -> Vec<SweptPlan> {
    let points: Vec<[f64; 2]> = made.iter().map(|(_, point)| *point).collect();
    let front = front(&points);
    let mut seen: BTreeSet<String> = all.iter().map(|plan| plan.id.clone()).collect();
    let mut proposed = Vec::new();
    for pair in front.windows(2) {
        let [one, other] = [0, 1].map(|i| made[pair[i]].0);
        for (own, towards) in [(one, other), (other, one)] {
            let between = half_way(own, towards, ground);
            if seen.insert(between.id.clone()) {
                proposed.push(between);
            }
        }
    }
    proposed
}

/// Returns the relative growth of the area that the front dominates, from the first `before` points to all `points`.
/// It is infinite if the area was 0.
pub fn growth(points: &[[f64; 2]], before: usize) -> f64 {
    let front = front(points);
    let corner = [0, 1].map(|k| BEYOND * front.iter().map(|&i| points[i][k]).fold(0.0, f64::max));
    let old = dominated_area(&points[..before], corner);
    let new = dominated_area(points, corner);
    if old > 0.0 { new / old - 1.0 } else { f64::INFINITY }
}

/// Returns `own` with its numbers half way to those of `other`: the geometric mean of two positive numbers, otherwise
/// the arithmetic one. Words stay, and so do whole numbers such as seeds and passes, which have no values between them.
/// `ground` is that of the sweep.
fn half_way(own: &SweptPlan, other: &SweptPlan, ground: &Ground) -> SweptPlan {
    let settings = own.settings.iter().map(|(key, value)| {
        let is_whole = SETTINGS.iter().any(|setting| setting.key == *key && setting.is_whole());
        let between = match (value, other.get(key)) {
            (SettingValue::Number(a), Some(SettingValue::Number(b))) if !is_whole => {
                SettingValue::Number(mean(*a, *b))
            }
            _ => value.clone(),
        };
        (key.clone(), between)
    });
    SweptPlan::new(&own.path, &own.method, settings.collect(), ground)
}

fn mean(a: f64, b: f64) -> f64 {
    if a == b {
        a
    } else if a > 0.0 && b > 0.0 {
        rounded((a * b).sqrt())
    } else {
        rounded((a + b) / 2.0)
    }
}

/// Rounds to 4 significant digits, which are enough to tell plans apart.
fn rounded(x: f64) -> f64 {
    format!("{x:.3e}").parse().expect("a formatted number is one")
}

/// Describes a plan as a phrase: path, method and settings, without those that a sweep does not vary.
pub fn in_words(plan: &SweptPlan) -> String {
    let settings = plan.settings.iter();
    let settings = settings.filter(|(key, _)| SETTINGS.iter().any(|setting| setting.key == *key));
    let settings: Vec<String> = settings.map(|(key, value)| format!("{key}={value}")).collect();
    format!("{}, {}: {}", plan.path, plan.method, settings.join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ground() -> Ground {
        Ground {
            surface: "s".into(),
            tools: vec![("".into(), "t".into())],
            varying: vec![],
            own_varying: None,
            machine: "m".into(),
            process: None,
            specification: None,
        }
    }

    fn made(path: &str, pitch_mm: f64, price: f64) -> SweptPlan {
        let settings = [("pitch_mm", pitch_mm), ("time_weight_nm2_per_s", price)];
        let settings = settings.map(|(k, x)| (k.to_string(), SettingValue::Number(x)));
        SweptPlan::new(path, "joint", settings.to_vec(), &ground())
    }

    #[test]
    fn between_two_neighbours_lie_their_geometric_means() {
        let (a, b) = (made("raster", 1.0, 1e-6), made("raster", 4.0, 1e-4));
        let off = made("raster", 9.0, 1e-5);
        let points = [(&a, [10.0, 1.0]), (&b, [5.0, 2.0]), (&off, [11.0, 3.0])];
        let proposed = proposals(&points, &[&a, &b, &off], &ground());
        let [one] = &proposed[..] else { panic!("one proposal: {proposed:?}") };
        assert_eq!(one.number("pitch_mm"), Some(2.0));
        assert_eq!(one.number("time_weight_nm2_per_s"), Some(1e-5));
        // What is there is not proposed again.
        assert!(proposals(&points, &[&a, &b, &off, one], &ground()).is_empty());
    }

    #[test]
    fn neighbours_of_two_families_are_each_moved_towards_the_other() {
        let (a, b) = (made("raster", 1.0, 1e-6), made("maze", 4.0, 1e-4));
        let points = [(&a, [10.0, 1.0]), (&b, [5.0, 2.0])];
        let proposed = proposals(&points, &[&a, &b], &ground());
        let paths: Vec<&str> = proposed.iter().map(|p| p.path.as_str()).collect();
        assert_eq!(paths, ["maze", "raster"]);
        assert!(proposed.iter().all(|p| p.number("pitch_mm") == Some(2.0)));
    }

    #[test]
    fn a_search_on_a_known_curve_ends() {
        // Residual 1 / price against time price: the front is the hyperbola, and every point lies on it. Halving gaps
        // fills the area below the hyperbola, so the front moves less and less.
        let point = |plan: &SweptPlan| {
            let price = plan.number("time_weight_nm2_per_s").unwrap();
            [price, 1.0 / price]
        };
        let mut plans = vec![made("raster", 1.0, 1.0), made("raster", 1.0, 256.0)];
        let mut steps = Vec::new();
        for _ in 0..8 {
            let found: Vec<Made<'_>> = plans.iter().map(|p| (p, point(p))).collect();
            let before = plans.len();
            let next = proposals(&found, &plans.iter().collect::<Vec<_>>(), &ground());
            plans.extend(next);
            let points: Vec<[f64; 2]> = plans.iter().map(point).collect();
            steps.push(growth(&points, before));
            if steps.last().unwrap() < &0.01 {
                break;
            }
        }
        assert!(steps.windows(2).skip(1).all(|s| s[1] < s[0]), "{steps:?}");
        assert!(*steps.last().unwrap() < 0.01, "{steps:?}");
        // Each round halves every gap.
        assert_eq!(plans.len(), (1 << steps.len()) + 1);
    }
}
