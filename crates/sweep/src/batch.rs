//! Choice of the plans that a job (one of several processes, perhaps on a cluster) runs, and estimates of the time and
//! memory that it needs.
//!
//! Time and memory are those of the stages, estimated from the size of the map and the path:
//!
//! | symbol | what |
//! |---|---|
//! | A | area of the map, mm^2 |
//! | p | pitch, mm |
//! | w | width of the tool, mm: the standard deviation of a Gaussian TIF |
//! | N | pixels of the map |
//!
//! The path has the length A / p. A plan of motion and times as one problem has n = A / (0.6 p w) nodes, 0.6 w apart
//! along the path. Of these, m = (8 w)^2 / (0.6 p w) are within reach of each other. The plan takes about 30
//! factorisations with n m^2 multiplications. The closed loop has A / (p s) dwell points for steps of s.

use serde::{Deserialize, Serialize};

use crate::plan::SweptPlan;

/// Size of a mirror, from which the time and memory of a job are estimated.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Size {
    /// Number of pixels of the map, invalid ones included.
    pub pixels: f64,
    /// Area of all pixels of the map, mm^2, invalid ones included.
    pub area_mm2: f64,
    /// Width of the mirror's own TIF, mm; for a Gaussian it is the standard deviation.
    pub tool_width_mm: f64,
}

/// Time and memory that a job asks the cluster for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Resources {
    /// Time limit of the job, minutes; at least 10.
    pub runtime: u64,
    /// Memory limit of the job, MiB.
    pub mem_mb: u64,
}

/// Time of a factorisation per multiplication on one core, s. Larger: longer time limits of jobs. Smaller: jobs are
/// ended before they are done.
const S_PER_MULTIPLICATION: f64 = 1e-9;

/// Time of a closed loop (rounds of refinement of the dwell times) per dwell point on one core, s. Larger: longer
/// time limits of jobs. Smaller: jobs are ended before they are done.
const S_PER_DWELL_POINT: f64 = 5e-3;

/// Smallest time of a plan, s: its programs start, compute hashes and write files. Larger: longer time limits of
/// jobs. Smaller: jobs with small plans are ended before they are done.
const S_AT_LEAST: f64 = 1.0;

/// Factor on the estimated time after which a job is ended, dimensionless. The estimate is rough, and a job that is
/// ended must begin again. Larger: jobs wait longer in the queue of a cluster. Smaller: jobs are ended before they
/// are done.
const TIME_MARGIN: f64 = 5.0;

/// Memory of a stage per pixel, bytes: about twenty maps of 8 bytes, and transforms of twice their size. Larger:
/// fewer jobs fit on a machine. Smaller: jobs run out of memory.
const BYTES_PER_PIXEL: f64 = 1000.0;

/// Memory of a stage of any size, bytes. Larger: fewer jobs fit on a machine. Smaller: jobs with small maps run out
/// of memory.
const BYTES_AT_LEAST: f64 = 400.0 * 1048576.0;

/// Returns the estimated time of a plan on one core, s. A plan without a pitch counts as one of 1 mm, and one without a
/// step as one whose step is the pitch. `size` is that of the mirror.
pub fn estimated_s(plan: &SweptPlan, size: &Size) -> f64 {
    let pitch_mm = plan.number("pitch_mm").or(plan.number("min_pitch_mm")).unwrap_or(1.0);
    let step_mm = plan.number("step_mm").unwrap_or(pitch_mm);
    let passes = plan.number("passes").unwrap_or(1.0);
    let Size { area_mm2, tool_width_mm, .. } = *size;
    let own_s = if plan.method == "joint" {
        let spacing_mm = plan.number("node_spacing_mm").unwrap_or(0.6 * tool_width_mm);
        let nodes = area_mm2 / (pitch_mm * spacing_mm);
        let near = (8.0 * tool_width_mm).powi(2) / (pitch_mm * spacing_mm);
        // The stage sets its nodes further apart where a factorisation would take more than this, and halves
        // spans until it takes five times as much, or this: a dozen steps before, and twenty after that.
        let most = 5e10f64;
        let first = (nodes * near * near).min(most);
        S_PER_MULTIPLICATION * (12.0 * first + 20.0 * (5.0 * first).min(most))
    } else {
        S_PER_DWELL_POINT * passes * area_mm2 / (pitch_mm * step_mm)
    };
    S_AT_LEAST + own_s
}

/// Returns the time and memory of a job that makes `plans`, of which it runs `jobs` at the same time. `size` is that of
/// the mirror.
pub fn resources(plans: &[&SweptPlan], size: &Size, jobs: usize) -> Resources {
    let estimated = plans.iter().map(|plan| estimated_s(plan, size));
    let (sum_s, longest_s) =
        estimated.fold((0.0, 0.0f64), |(sum, longest), s| (sum + s, longest.max(s)));
    let wall_s = (sum_s / jobs as f64).max(longest_s);
    let bytes = jobs as f64 * (BYTES_AT_LEAST + BYTES_PER_PIXEL * size.pixels);
    Resources {
        runtime: (TIME_MARGIN * wall_s / 60.0).ceil().max(10.0) as u64,
        mem_mb: (bytes / 1048576.0).ceil() as u64,
    }
}

/// Returns the members of job `index` (from 0) of `jobs`. The most expensive ones are dealt out first, in turn, so
/// that the jobs take about the same time. Within a job, `cost` descends.
pub fn members<T>(mut all: Vec<T>, cost: impl Fn(&T) -> f64, index: usize, jobs: usize) -> Vec<T> {
    // Stable: equal ones stay in the order of the sweep, so that the members are the same everywhere.
    all.sort_by(|a, b| cost(b).total_cmp(&cost(a)));
    let mut members = Vec::new();
    for (k, member) in all.into_iter().enumerate() {
        // There and back: 0, 1, 2, 2, 1, 0, ...
        let place = k % jobs;
        let turn = if (k / jobs).is_multiple_of(2) { place } else { jobs - 1 - place };
        if turn == index {
            members.push(member);
        }
    }
    members
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::outcome::sweep::SettingValue;

    fn plan(method: &str, settings: &[(&str, f64)]) -> SweptPlan {
        let settings =
            settings.iter().map(|(k, x)| (k.to_string(), SettingValue::Number(*x))).collect();
        SweptPlan {
            id: "id".into(),
            path_id: "path".into(),
            dwell_id: None,
            path: "raster".into(),
            method: method.into(),
            settings,
        }
    }

    const SIZE: Size = Size { pixels: 1e4, area_mm2: 1e3, tool_width_mm: 3.0 };

    #[test]
    fn every_plan_is_in_one_job_and_the_jobs_cost_the_same() {
        let all: Vec<u32> = (0..100).collect();
        let jobs: Vec<Vec<u32>> =
            (0..7).map(|i| members(all.clone(), |x| f64::from(*x), i, 7)).collect();
        let mut seen: Vec<u32> = jobs.iter().flatten().copied().collect();
        seen.sort();
        assert_eq!(seen, all);
        let sums: Vec<u32> = jobs.iter().map(|job| job.iter().sum()).collect();
        // There and back, two rounds cancel; what is left is one member more or less, the cheapest of them.
        let (least, most) = (sums.iter().min().unwrap(), sums.iter().max().unwrap());
        assert!(most - least <= 12, "{sums:?}");
    }

    #[test]
    fn finer_plans_are_estimated_to_take_longer() {
        for method in ["joint", "pvt+refined"] {
            let of = |pitch: f64| {
                estimated_s(&plan(method, &[("pitch_mm", pitch), ("step_mm", 1.0)]), &SIZE)
            };
            assert!(of(0.5) > of(1.0) && of(1.0) > of(2.0), "{method}");
        }
    }

    #[test]
    fn resources_grow_with_the_map_and_the_plans() {
        let one = plan("joint", &[("pitch_mm", 1.0)]);
        let large = Size { pixels: 4e6, area_mm2: 4e4, tool_width_mm: 3.0 };
        let (few, many) = (vec![&one; 10], vec![&one; 1000]);
        assert!(resources(&many, &SIZE, 2).runtime > resources(&few, &SIZE, 2).runtime);
        assert!(resources(&many, &SIZE, 8).runtime < resources(&many, &SIZE, 2).runtime);
        assert!(resources(&few, &large, 2).mem_mb > resources(&few, &SIZE, 2).mem_mb);
        // One plan is not run by two cores.
        assert_eq!(resources(&[&one], &SIZE, 8).runtime, resources(&[&one], &SIZE, 1).runtime);
    }
}
