//! Expansion of a sweep: every combination of the settings in its file, as plans.

use std::collections::BTreeSet;

use planish_types::outcome::sweep::SettingValue;

use crate::{
    description::Block,
    plan::{Ground, SweptPlan},
    setting::SETTINGS,
};

/// Largest number of plans of a sweep; more are refused. Larger: a mistyped range fills a disk. Smaller: large sweeps
/// must be divided.
const MOST_PLANS: usize = 200_000;

/// Makes the plans of the blocks, each plan once, in the order of the file. `ground` holds the hashes of everything
/// that all plans share.
///
/// A setting that does not concern a path or a method is left out of its plans, so that they are not made twice.
///
/// # Errors
/// Fails with a message if there are too many plans.
pub fn expand(blocks: &[Block], ground: &Ground) -> Result<Vec<SweptPlan>, String> {
    let mut plans = Vec::new();
    let mut seen = BTreeSet::new();
    for block in blocks {
        for path in &block.paths {
            for method in &block.methods {
                for settings in combinations(block, path, method)? {
                    let plan = SweptPlan::new(path, method, settings, ground);
                    if seen.insert(plan.id.clone()) {
                        plans.push(plan);
                    }
                    if plans.len() > MOST_PLANS {
                        return Err(too_many());
                    }
                }
            }
        }
    }
    Ok(plans)
}

fn too_many() -> String {
    format!("the sweep has more than {MOST_PLANS} plans; give shorter lists")
}

/// Returns every combination of the settings that the path and the method depend on; the last setting varies fastest.
fn combinations(
    block: &Block,
    path: &str,
    method: &str,
) -> Result<Vec<Vec<(String, SettingValue)>>, String> {
    let mut combinations = vec![vec![]];
    for (key, values) in &block.settings {
        let setting = SETTINGS.iter().find(|setting| setting.key == *key);
        if !setting.is_some_and(|setting| setting.concerns(path, method)) {
            continue;
        }
        if combinations.len().saturating_mul(values.len()) > MOST_PLANS {
            return Err(too_many());
        }
        let mut longer = Vec::new();
        for shorter in &combinations {
            for value in values {
                longer.push([&shorter[..], &[(key.clone(), value.clone())]].concat());
            }
        }
        combinations = longer;
    }
    Ok(combinations)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ground() -> Ground {
        Ground {
            surface: "s".into(),
            tools: vec![("".into(), "t".into()), ("narrow".into(), "n".into())],
            varying: vec![],
            own_varying: None,
            machine: "m".into(),
            process: None,
            specification: None,
        }
    }

    fn numbers(key: &str, values: &[f64]) -> (String, Vec<SettingValue>) {
        (key.into(), values.iter().copied().map(SettingValue::Number).collect())
    }

    fn block(
        paths: &[&str],
        methods: &[&str],
        settings: Vec<(String, Vec<SettingValue>)>,
    ) -> Block {
        let owned = |words: &[&str]| words.iter().map(|w| w.to_string()).collect();
        Block { paths: owned(paths), methods: owned(methods), settings }
    }

    #[test]
    fn every_combination_is_a_plan_once() {
        let settings = vec![
            numbers("pitch_mm", &[1.0, 2.0]),
            numbers("seed", &[1.0, 2.0, 3.0]),
            numbers("time_elasticity", &[0.5, 1.0]),
        ];
        let block = block(&["raster", "maze"], &["joint", "pvt+refined"], settings);
        let plans = expand(&[block.clone(), block], &ground()).unwrap();
        // A raster has no seed, and the closed loop no elasticity: 2 (2 + 1) + 6 (2 + 1).
        assert_eq!(plans.len(), 2 * 3 + 6 * 3);
        let ids: BTreeSet<_> = plans.iter().map(|p| &p.id).collect();
        assert_eq!(ids.len(), plans.len());
    }

    #[test]
    fn what_plans_have_in_common_has_one_name() {
        let prices = vec![numbers("time_weight_nm2_per_s", &[0.0, 1e-5, 1e-4])];
        let plans =
            expand(&[block(&["raster"], &["joint", "pvt+refined"], prices)], &ground()).unwrap();
        assert_eq!(plans.len(), 6);
        let paths: BTreeSet<_> = plans.iter().map(|p| &p.path_id).collect();
        let dwell: BTreeSet<_> = plans.iter().filter_map(|p| p.dwell_id.as_ref()).collect();
        assert_eq!((paths.len(), dwell.len()), (1, 1));
    }

    #[test]
    fn a_name_changes_with_everything_that_its_plan_is_made_of_and_with_nothing_else() {
        let id = |ground: &Ground, pitch_mm: f64, weight: f64| {
            let settings = vec![
                ("pitch_mm".into(), SettingValue::Number(pitch_mm)),
                ("time_weight_nm2_per_s".into(), SettingValue::Number(weight)),
            ];
            SweptPlan::new("raster", "joint", settings, ground)
        };
        let base = id(&ground(), 1.0, 0.0);
        assert_eq!(base, id(&ground(), 1.0, 0.0));
        let changed = |ground: Ground, pitch_mm, weight| {
            let other = id(&ground, pitch_mm, weight);
            assert_ne!(base.id, other.id);
            base.path_id != other.path_id
        };
        assert!(changed(Ground { surface: "other".into(), ..ground() }, 1.0, 0.0));
        assert!(changed(Ground { tools: vec![("".into(), "o".into())], ..ground() }, 1.0, 0.0));
        assert!(changed(ground(), 1.5, 0.0));
        // The path is judged by the travel of the machine, and knows neither error budget nor price.
        assert!(changed(Ground { machine: "other".into(), ..ground() }, 1.0, 0.0));
        assert!(!changed(Ground { process: Some("p".into()), ..ground() }, 1.0, 0.0));
        assert!(!changed(ground(), 1.0, 1e-4));
        // What is given as it would be taken anyway is the same plan.
        assert_eq!(SweptPlan::new("raster", "joint", vec![], &ground()).path_id, base.path_id);
    }

    #[test]
    fn too_many_plans_are_refused_before_they_are_made() {
        let long: Vec<f64> = (0..10_000).map(f64::from).collect();
        let settings = vec![numbers("pitch_mm", &long), numbers("step_mm", &long)];
        let said = expand(&[block(&["raster"], &["joint"], settings)], &ground()).unwrap_err();
        assert!(said.contains("more than 200000 plans"), "{said}");
    }
}
