//! The B-spline feed, judged by the simulator and by verify, with which it shares no code.

use std::fs;

use planish_bspline_feed::{
    FeedPlan, FeedSettings, deconvolution::Refinement, plan, plan::FeedSource,
};
use planish_fixture::{Recipe, make};
use planish_simulate::simulate;
use planish_testkit::{machine, workspace};
use planish_toolpath::{RasterSettings, raster};
use planish_types::{Limits, Surface, Tif, ToolPath};
use planish_verify::{VerifySettings, verify};

/// The fixture mirror, lifted so that its lowest pixel is at 0.
fn mirror(name: &str) -> (Surface, Tif) {
    let file = workspace().join("fixtures").join(format!("{name}.json"));
    let recipe: Recipe = serde_json::from_str(&fs::read_to_string(file).unwrap()).unwrap();
    let mirror = make(&recipe).unwrap();
    let lowest = mirror.surface.statistics().min;
    let height = mirror.surface.height_nm() - lowest;
    (Surface::new(*mirror.surface.grid(), height).unwrap(), mirror.tif)
}

fn lines(surface: &Surface, tif: &Tif, pitch_mm: f64) -> ToolPath {
    let settings = RasterSettings::new(pitch_mm, pitch_mm, tif.half_size_mm()[0]);
    raster(surface, &settings).unwrap()
}

/// RMS of the executed residual; the limits of the whole motion are proven on the way.
fn executed_rms_nm(plan: &FeedPlan, surface: &Surface, tif: &Tif, limits: &Limits) -> f64 {
    let verdict = verify(&plan.trajectory, limits, &VerifySettings::default()).unwrap();
    assert!(verdict.limits_respected, "{:?}", verdict.reason());
    let gridded = planish_simulate::SimulationSettings::Gridded;
    simulate(&plan.trajectory, tif, surface, gridded).unwrap().removal.residual().statistics().rms
}

#[test]
fn the_coupon_is_executed_as_planned_within_the_limits() {
    let (surface, tif) = mirror("coupon");
    let path = lines(&surface, &tif, 1.0);
    let limits = machine([50.0, 30.0], [400.0, 200.0]);
    let with = |settings: FeedSettings| plan(&surface, &tif, &path, &limits, &settings).unwrap();
    let base = FeedSettings { relative_gap: 1e-2, ..FeedSettings::default() };
    let solved = with(base);
    let removed = with(FeedSettings { refinement: Refinement::KnotRemoval, ..base });
    let vrr = with(FeedSettings { method: FeedSource::Vrr, ..base });
    let rms = [&solved, &removed, &vrr].map(|p| executed_rms_nm(p, &surface, &tif, &limits));
    // Two quadratures of the same removal: five Gauss points per knot span against an exact cut
    // at the lattice lines. The TIF ends with a step of 0.2 % of its peak.
    for (plan, rms) in [&solved, &removed].iter().zip(rms) {
        let model = plan.report.model_rms_nm.unwrap();
        assert!((rms / model - 1.0).abs() < 1e-2, "{rms} {model}");
    }
    assert!(rms[0] < rms[1] && rms[1] < rms[2], "{rms:?}");
    println!("deconvolution, knot removal, VRR: {rms:?} nm");
    // The baseline blurs what the deconvolution does not.
    // Regression bound: measured 0.39 of what the baseline leaves on the coupon.
    assert!(rms[0] < 0.5 * rms[2], "{rms:?}");
}
