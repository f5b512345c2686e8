//! The tables of docs/joint.md: motion and times as one problem, beside the closed loop on the same path.
//!
//! Every number is that of the executed motion. The closed loop has a floor of 0.02 s/mm and its own price
//! of time.

use planish_dwell::bounded_least_squares::Bound;
use planish_fixture::Fixture;
use planish_joint::{JointSettings as Settings, Price, plan};
use planish_schedule::pvt::Mode;
use planish_testkit::{
    ion_beam, machine,
    mirror::{self, Mirror},
};
use planish_toolpath::{Construction, Scan};
use planish_types::{Limits, Surface, Tif, ToolPath, plausible::Rms};

use crate::{
    Case,
    paths::{fixture, lines, own_maze, random},
    smooth,
};

/// Distance of the nodes of the third plan on the mirror, mm. Larger: fewer unknowns, a coarser feed.
/// Smaller: a finer feed in more time.
const FINE_SPACING_MM: f64 = 0.8;
/// Elasticity of the third plan: decrease of the mean square, %, for 1 % more time. Larger: time is dearer,
/// and the plan is shorter with a larger residual. Smaller: the reverse.
const FINE_ELASTICITY: f64 = 0.6;

/// Elasticity of the second plan, and of the second plan of the fixtures; see [`FINE_ELASTICITY`].
const DEARER_ELASTICITY: f64 = 0.75;

const SEEDS: std::ops::RangeInclusive<u64> = 1..=5;

fn heading(title: &str, plans: &[Settings]) {
    let name = |s: &Settings| {
        let nodes = s.node_spacing_mm.map_or("default".into(), |mm| format!("nodes {mm} mm apart"));
        match s.price {
            Price::Elasticity(x) => format!(" {nodes}, elasticity {x}: nm | s |"),
            Price::Nm2PerS(price) => format!(" {nodes}, {price:e} nm^2/s: nm | s |"),
        }
    };
    let plans_head: String = plans.iter().map(name).collect();
    println!("\n{title}\n\n| path | closed loop: nm | s |{plans_head}");
    println!("|---|---|---|{}", "---|---|".repeat(plans.len()));
}

/// A mirror and a machine.
struct Part<'a> {
    desired: &'a Surface,
    tif: &'a Tif,
    limits: &'a Limits,
    plans: &'a [Settings],
}

impl Part<'_> {
    /// RMS (nm) and time (s) of the closed loop and of the plans, in this order.
    fn measured(&self, path: &ToolPath) -> Vec<[f64; 2]> {
        let Self { desired, tif, limits, plans } = *self;
        let floor = Bound::SecondsPerMm(0.02);
        let mode = Mode::within(limits);
        let case = Case { desired, tif, limits, mode, floor, noise_rms_nm: None };
        let refined = case.refined(path);
        let best = &refined.iterates[refined.best];
        assert!(best.limits_respected);
        let of = |settings: &Settings| {
            let plan = plan(desired, tif, path, limits, settings).expect("a plan");
            assert_eq!(plan.refused, None);
            [Rms::of_surface(plan.removal.residual()).rms_nm, plan.trajectory.total_time_s()]
        };
        let closed_loop = [best.rms_nm, best.total_time_s];
        std::iter::once(closed_loop).chain(plans.iter().map(of)).collect()
    }

    fn row(&self, name: &str, path: &ToolPath) {
        print_row(name, &self.measured(path));
    }

    /// Random-adaptive paths: residuals and times of the seeds, each in the middle of its own order.
    fn median_of_seeds(&self) {
        let of_seed = |seed| self.measured(&random(self.desired, Construction::MeshTree, seed));
        let seeds: Vec<_> = SEEDS.map(of_seed).collect();
        let median = |method: usize, k: usize| {
            let mut all: Vec<f64> = seeds.iter().map(|m| m[method][k]).collect();
            all.sort_by(f64::total_cmp);
            all[all.len() / 2]
        };
        let middle: Vec<_> = (0..=self.plans.len()).map(|m| [median(m, 0), median(m, 1)]).collect();
        print_row(&format!("random-adaptive, median of {} seeds", seeds.len()), &middle);
    }
}

fn print_row(name: &str, of: &[[f64; 2]]) {
    let cells: String = of.iter().map(|[rms, time]| format!(" {rms:.4} | {time:.1} |")).collect();
    println!("| {name} |{cells}");
}

fn on_the_mirror(title: &str, reference: &Mirror, limits: &Limits) {
    let (desired, tif) = (&reference.desired, &reference.tif);
    let paths = [
        ("published raster", reference.path("raster")),
        ("raster", lines(desired, tif, 1.0, Scan::X)),
        ("raster at 30 degrees", lines(desired, tif, 1.0, Scan::Angle { angle_deg: 30.0 })),
        ("maze", own_maze(desired)),
    ];
    let at = |elasticity| Settings { price: Price::Elasticity(elasticity), ..Settings::default() };
    let fine = Settings { node_spacing_mm: Some(FINE_SPACING_MM), ..at(FINE_ELASTICITY) };
    let plans = [Settings::default(), at(DEARER_ELASTICITY), fine];
    heading(title, &plans);
    let part = Part { desired, tif, limits, plans: &plans };
    for (name, path) in &paths {
        part.row(name, path);
    }
    part.median_of_seeds();
}

fn on_fixtures() {
    let price = Price::Elasticity(DEARER_ELASTICITY);
    let dearer = Settings { price, ..Settings::default() };
    let (limits, plans) = (&ion_beam(), &[Settings::default(), dearer]);
    heading("Fixtures", plans);
    for (name, pitch_mm) in
        [("coupon", 1.0), ("flat-92x16", 1.0), ("disk-100", 1.0), ("square-200", 2.0)]
    {
        let Fixture { surface, tif, .. } = fixture(name, true);
        let path = lines(&surface, &tif, pitch_mm, Scan::X);
        let part = Part { desired: &surface, tif: &tif, limits, plans };
        part.row(&format!("`{name}`, raster {pitch_mm} mm"), &path);
    }
}

/// The tables of these names, or all: of the reference mirror, where it is there, and of fixtures.
pub fn tables(names: &[String]) {
    let wanted = |name: &str| names.is_empty() || names.iter().any(|n| n == name);
    if let Some(reference) = mirror::mirror() {
        if wanted("mirror") {
            on_the_mirror("The reference mirror", &reference, &ion_beam());
        }
        if wanted("slow") {
            let slow = machine([25.0, 15.0], [200.0, 100.0]);
            on_the_mirror("The same, a tenth of every limit", &reference, &slow);
        }
        if wanted("jerk") {
            smooth::limits_on_jerk(&reference);
        }
        if wanted("servo") {
            smooth::servos(&reference);
        }
    }
    if wanted("fixtures") {
        on_fixtures();
    }
}
