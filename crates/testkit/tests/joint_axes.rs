//! Joint plans for machines with more axes than x and y: the plan itself keeps the limits of all axes, so that the motion
//! of the axes takes hardly longer. The coupon with a fast tool, on spheres.
//!
//! The table of docs/axes.md: `cargo test --release -p planish-testkit --test joint_axes -- --nocapture`

use planish_axes::{MotionReport, MotionSettings, motion};
use planish_fixture::{Fixture, make};
use planish_form::Form;
use planish_joint::{MachineAxes, Plan, Price, Settings, plan, plan_with_further_axes};
use planish_testkit::workspace;
use planish_toolpath::{RasterSettings, SpiralSettings, raster, spiral};
use planish_types::{End, Grid, Machine, MachineFile, Surface, Tif, ToolPath, plausible::Rms};
use planish_verify::{VerifySettings, verify_axes};

/// Factor on the rate of the coupon's tool. Larger: a faster motion, which uses more of the limits. Smaller: limits that
/// matter in the turns alone. Chosen: the mean feedrate is some 10 mm/s.
const FASTER: f64 = 5.0;

/// Half the length of the coupon, mm: there the sphere has its edge slope.
const HALF_MM: f64 = 10.0;

/// Largest time that the axes may add to a plan with rows for them, over its time. The cubics of the axes differ from
/// the exact positions of the plan by some 1e-3 of a limit, and places with an excess are slowed down for some 10 ms.
const MOST_ADDED: f64 = 5e-3;

fn machine(name: &str) -> Machine {
    let path = workspace().join(format!("fixtures/machines/{name}.json"));
    let text = std::fs::read_to_string(path).unwrap();
    Machine::new(serde_json::from_str::<MachineFile>(&text).unwrap()).unwrap()
}

/// The coupon with its middle at the origin, and a fast tool.
struct Part {
    surface: Surface,
    tif: Tif,
}

fn coupon() -> Part {
    let text = std::fs::read_to_string(workspace().join("fixtures/coupon.json")).unwrap();
    let Fixture { surface, tif, .. } = make(&serde_json::from_str(&text).unwrap()).unwrap();
    let Grid { x, y } = *surface.grid();
    let grid = Grid { x, y }.moved([&x, &y].map(|a| -0.5 * (a.start_mm() + a.end_mm()))).unwrap();
    Part {
        surface: Surface::new(grid, surface.height_nm().clone()).unwrap(),
        tif: Tif::new(*tif.grid(), FASTER * tif.rate_nm_per_s()).unwrap(),
    }
}

/// Lines 1 mm apart, none of them through the middle.
fn lines(part: &Part) -> ToolPath {
    let settings =
        RasterSettings { line_origin_mm: Some(0.5), ..RasterSettings::new(1.0, 1.0, 3.5) };
    raster(&part.surface, &settings).unwrap()
}

fn turns(part: &Part) -> ToolPath {
    let settings = SpiralSettings { pitch_mm: 1.0, step_mm: 1.0, overscan_mm: 1.0 };
    spiral(&part.surface, &settings).unwrap()
}

/// A plan, the report on the motion of its axes, and whether this motion keeps all limits.
struct Made {
    plan: Plan,
    axes: MotionReport,
    kept: bool,
}

impl Made {
    fn added(&self) -> f64 {
        self.axes.total_time_s / self.axes.planned_time_s - 1.0
    }
}

fn made(part: &Part, path: &ToolPath, machine: &Machine, form: &Form, rows: bool) -> Made {
    // The same price for all, so that the times compare.
    let settings = Settings { price: Price::Nm2PerS(1e-3), ..Settings::default() };
    let limits = machine.limits_on_part();
    let axes = MachineAxes::new(machine, form).unwrap().expect("more axes than x and y");
    let plan = match rows {
        false => plan(&part.surface, &part.tif, path, &limits, &settings),
        true => plan_with_further_axes(&part.surface, &part.tif, path, (&limits, &axes), &settings),
    }
    .unwrap();
    let (executed, axes) =
        motion(&plan.trajectory, machine, form, &MotionSettings::default()).unwrap();
    let verdict = verify_axes(&executed, machine, &VerifySettings::default()).unwrap();
    Made { plan, axes, kept: verdict.limits_respected }
}

/// Plans a case with and without rows for the axes, prints both and judges the one with rows.
fn compare(name: &str, slope_deg: f64, path: (&str, fn(&Part) -> ToolPath)) {
    let (part, machine) = (coupon(), machine(name));
    let form = Form::sphere(-HALF_MM / slope_deg.to_radians().sin(), [0.0; 2]).unwrap();
    let points = path.1(&part);
    let [without, with] = [false, true].map(|rows| made(&part, &points, &machine, &form, rows));
    let rms_nm = |made: &Made| Rms::of(made.plan.removal.residual()).rms_nm;
    println!(
        "| {name} | {slope_deg} | {} | {:.2} | {:.4} | {:.2} % | {:.2} | {:.4} | {:.3} % | {} |",
        path.0,
        without.axes.planned_time_s,
        rms_nm(&without),
        100.0 * without.added(),
        with.axes.planned_time_s,
        rms_nm(&with),
        100.0 * with.added(),
        with.plan.report.near_limits(),
    );
    let r = &with.plan.report;
    println!("    {} rounds, slowed by {:?}, {:?}", r.rounds, r.slowed_by, with.axes.slowed);
    assert!(with.kept && with.plan.refused.is_none(), "{:?}", with.plan.refused);
    assert_eq!(r.end, End::Optimal);
    assert!(with.added() <= MOST_ADDED, "{} of the time is added", with.added());
    // The tolerance of `planish-axes motion`
    assert!(with.axes.contact_deviation_um <= 2.0, "{}", with.axes.contact_deviation_um);
}

#[test]
fn five_axes_on_a_sphere_take_the_time_of_the_plan() {
    compare("bonnet-five-axis", 10.0, ("raster", lines));
    compare("bonnet-five-axis", 20.0, ("raster", lines));
    compare("bonnet-five-axis", 20.0, ("spiral", turns));
}

#[test]
fn z_on_a_sphere_takes_the_time_of_the_plan() {
    compare("ion-beam-xyz", 20.0, ("raster", lines));
    compare("ion-beam-xyz", 20.0, ("spiral", turns));
}

#[test]
fn a_spindle_with_a_tilt_takes_the_time_of_the_plan() {
    compare("spindle", 10.0, ("spiral", turns));
    compare("spindle", 20.0, ("raster", lines));
}
