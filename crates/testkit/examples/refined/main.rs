//! The tables of docs/refine.md: the closed loop on the reference mirror (`PLANISH_REFERENCE`), with a
//! tenth of the limits of the machine, and on the coupon with noise and with a ring-shaped tool, and every scheduler
//! (`schedulers`: these tables alone). With the argument `joint`: those of docs/joint.md, motion and times as one problem beside the closed loop. With `modes`: the shapes of the
//! PVT motion over fixtures and paths (docs/decisions/0071-pvt-mode-over-fixtures.md).

mod joint;
mod paths;
mod smooth;

use planish_dwell::bounded_least_squares::{self, Bound};
use planish_fixture::Fixture;
use planish_refine::{RefineSettings as Settings, Refined, refine};
use planish_schedule::{
    Choices, SCHEDULERS, Scheduler,
    pvt::{self, Mode, ModeChoice},
    trig_spline::Repair,
};
use planish_simulate::{SimulationSettings::Gridded, simulate};
use planish_testkit::{ion_beam, machine, mirror};
use planish_toolpath::{Construction, Scan};
use planish_types::{Limits, Surface, Tif, ToolPath};

use paths::{fixture, lines, own_maze, random};

/// Smallest dwell times of the tables, with their names.
const FLOORS: [(&str, Bound); 2] =
    [("0.1 s", Bound::Seconds(0.1)), ("0.02 s/mm", Bound::SecondsPerMm(0.02))];
/// The part, the tool, and the settings of a row.
struct Case<'a> {
    desired: &'a Surface,
    tif: &'a Tif,
    limits: &'a Limits,
    mode: Mode,
    floor: Bound,
    noise_rms_nm: Option<f64>,
}

impl Case<'_> {
    /// Refines the dwell times of the solver with its own settings, as a pipeline does.
    fn refined(&self, path: &ToolPath) -> Refined {
        self.refined_by(&pvt::PvtSettings::new(self.mode), path)
    }

    /// The same with any scheduler.
    fn refined_by(&self, scheduler: &dyn Scheduler, path: &ToolPath) -> Refined {
        let mut settings = Settings { scheduler, ..Settings::default() };
        settings.dwell.min_dwell = self.floor;
        settings.dwell.noise_rms_nm = self.noise_rms_nm;
        let solver =
            bounded_least_squares::BoundedSettings { min_dwell: self.floor, ..Default::default() };
        let first = bounded_least_squares::solve(self.desired, self.tif, path, None, &solver);
        let first = Some(first.expect("a plan").dwell);
        let refined = refine(self.desired, self.tif, path, self.limits, first, &settings);
        refined.expect("a motion")
    }

    fn row(&self, name: &str, floor: &str, path: &ToolPath) -> [f64; 2] {
        let refined = self.refined(path);
        let (before, after) = (&refined.iterates[0], &refined.iterates[refined.best]);
        assert!(after.limits_respected, "{name}");
        println!(
            "| {name} | {} | {floor} | {:.4} | {:.4} | {:.1} | {:.1} | {} |",
            path.len(),
            before.rms_nm,
            after.rms_nm,
            before.total_time_s,
            after.total_time_s,
            refined.iterates.len(),
        );
        [after.rms_nm, after.total_time_s]
    }
}

fn heading() {
    println!("| path | points | floor | before, nm | after, nm | before, s | after, s | rounds |");
    println!("|---|---|---|---|---|---|---|---|");
}

fn on_the_mirror(reference: &mirror::Mirror) {
    let (desired, tif, limits) = (&reference.desired, &reference.tif, &ion_beam());
    let case = |limits, floor| Case {
        desired,
        tif,
        limits,
        mode: Mode::Monotone,
        floor,
        noise_rms_nm: None,
    };
    let paths = [
        ("published raster", reference.path("raster")),
        ("published maze", reference.path("maze")),
        ("own maze", own_maze(desired)),
    ];
    let seeds = |construction| (1..=5).map(move |seed| random(desired, construction, seed));
    let mesh: Vec<ToolPath> = seeds(Construction::MeshTree).collect();
    let tour: Vec<ToolPath> = seeds(Construction::Tour).collect();

    println!("\nThe reference mirror\n");
    heading();
    let mut summary = Vec::new();
    for (name, path) in &paths {
        for (floor, bound) in FLOORS {
            case(limits, bound).row(name, floor, path);
        }
    }
    for (name, paths) in [("mesh-tree", &mesh), ("tour", &tour)] {
        for (floor, bound) in FLOORS {
            let rows: Vec<[f64; 2]> = paths
                .iter()
                .zip(1..)
                .map(|(path, seed)| {
                    case(limits, bound).row(&format!("{name}, seed {seed}"), floor, path)
                })
                .collect();
            let sorted = |k: usize| {
                let mut all: Vec<f64> = rows.iter().map(|r| r[k]).collect();
                all.sort_by(f64::total_cmp);
                all
            };
            let (rms, time) = (sorted(0), sorted(1));
            summary.push(format!(
                "| {name} | {floor} | {:.4}, {:.4} | {:.1}, {:.1} |",
                rms[2], rms[4], time[2], time[4]
            ));
        }
    }
    println!("\nThe random-adaptive paths: median and worst of the seeds\n");
    println!("| construction | floor | after, nm | after, s |\n|---|---|---|---|");
    summary.iter().for_each(|line| println!("{line}"));

    println!("\nA tenth of every limit\n");
    heading();
    let slow = machine([25.0, 15.0], [200.0, 100.0]);
    let (floor, bound) = FLOORS[1];
    for (name, path) in &paths {
        case(&slow, bound).row(name, floor, path);
    }
    case(&slow, bound).row("mesh-tree, seed 1", floor, &mesh[0]);
    case(&slow, bound).row("tour, seed 1", floor, &tour[0]);
}

fn with_noise() {
    println!(
        "\nNoise of 5 %: `coupon-noise`, raster, residual against the measured and the true map\n"
    );
    println!(
        "| mode | floor | noise level given | measured before, nm | after, nm | true before, nm \
         | after, nm | before, s | after, s |\n|---|---|---|---|---|---|---|---|---|"
    );
    let (measured, truth) = (fixture("coupon-noise", true), fixture("coupon-noise", false));
    let (tif, limits) = (&measured.tif, &ion_beam());
    let path = lines(&measured.surface, tif, 1.0, Scan::X);
    let missed = |motion: &_| {
        let p = simulate(motion, tif, &truth.surface, Gridded).expect("a removal");
        p.removal.residual().statistics().rms
    };
    for (mode, name) in [(Mode::Monotone, "monotone"), (Mode::Smooth, "smooth")] {
        for (floor, bound) in FLOORS {
            for noise_rms_nm in [None, Some(0.5)] {
                let desired = &measured.surface;
                let case = Case { desired, tif, limits, mode, floor: bound, noise_rms_nm };
                let refined = case.refined(&path);
                let solver = bounded_least_squares::BoundedSettings {
                    min_dwell: bound,
                    ..Default::default()
                };
                let first = bounded_least_squares::solve(desired, tif, &path, None, &solver);
                let how = pvt::PvtSettings::new(mode);
                let first = first.expect("a plan").dwell;
                let first = pvt::schedule(&path, &first, limits, &how);
                let before = missed(&first.expect("a motion").trajectory);
                let after = missed(&refined.trajectory);
                assert!(after <= before, "{after} nm after, {before} nm before");
                let (r0, r1) = (&refined.iterates[0], &refined.iterates[refined.best]);
                println!(
                    "| {name} | {floor} | {} | {:.4} | {:.4} | {before:.4} | {after:.4} | {:.1} | {:.1} |",
                    if noise_rms_nm.is_some() { "0.5 nm" } else { "no" },
                    r0.rms_nm,
                    r1.rms_nm,
                    r0.total_time_s,
                    r1.total_time_s
                );
            }
        }
    }
}

fn on_the_coupons() {
    println!("\nThe coupon with a Gaussian tool, and with a ring\n");
    heading();
    for name in ["coupon", "coupon-ring"] {
        let Fixture { surface, tif, .. } = fixture(name, true);
        let path = lines(&surface, &tif, 1.0, Scan::X);
        for (mode, shape) in [(Mode::Monotone, "monotone"), (Mode::Smooth, "smooth")] {
            for (floor, bound) in FLOORS {
                let case = Case {
                    desired: &surface,
                    tif: &tif,
                    limits: &ion_beam(),
                    mode,
                    floor: bound,
                    noise_rms_nm: None,
                };
                case.row(&format!("{name}, {shape}"), floor, &path);
            }
        }
    }
}

/// Every scheduler of the closed loop along a raster and a maze, with the lower floor of the tables.
fn with_every_scheduler() {
    println!("\nEvery scheduler\n");
    println!(
        "| fixture, path | `--scheduler` | before, nm | after, nm | before, s | after, s | rounds |"
    );
    println!("|---|---|---|---|---|---|---|");
    let choices = [Repair::Offset, Repair::Local].map(|repair| Choices {
        mode: ModeChoice::Monotone,
        repair,
        ..Choices::default()
    });
    let limits = &ion_beam();
    for fixture_name in ["coupon", "flat-92x16"] {
        let Fixture { surface, tif, .. } = fixture(fixture_name, true);
        let (desired, mode, floor) = (&surface, Mode::Monotone, FLOORS[1].1);
        let case = Case { desired, tif: &tif, limits, mode, floor, noise_rms_nm: None };
        for (path_name, path) in
            [("raster", lines(desired, &tif, 1.0, Scan::X)), ("maze", own_maze(desired))]
        {
            for named in &SCHEDULERS {
                let mut all = Vec::from(choices.map(|choices| named.scheduler(&choices, limits)));
                all.dedup_by_key(|scheduler| scheduler.kind());
                for scheduler in all {
                    let refined = case.refined_by(&*scheduler, &path);
                    let (before, after) = (&refined.iterates[0], &refined.iterates[refined.best]);
                    assert!(after.limits_respected, "{scheduler:?}");
                    println!(
                        "| {fixture_name}, {path_name} | {}{} | {:.4} | {:.4} | {:.1} | {:.1} | {} |",
                        scheduler.name(),
                        scheduler.kind().map_or(String::new(), |kind| format!(", {kind}")),
                        before.rms_nm,
                        after.rms_nm,
                        before.total_time_s,
                        after.total_time_s,
                        refined.iterates.len(),
                    );
                }
            }
        }
    }
}

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    if let Some(("joint", names)) = words.split_first().map(|(first, rest)| (first.as_str(), rest))
    {
        return joint::tables(names);
    }
    if words.first().is_some_and(|first| first == "modes") {
        return smooth::modes(&words[1..]);
    }
    if words.first().is_some_and(|first| first == "schedulers") {
        return with_every_scheduler();
    }
    if let Some(reference) = mirror::mirror() {
        on_the_mirror(&reference);
    }
    with_every_scheduler();
    on_the_coupons();
    with_noise();
}
