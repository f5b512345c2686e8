//! What smoothness costs and what it is worth: limits on jerk along five paths, servos that follow the plans, and the
//! shapes of the PVT motion.

use planish_dwell::bounded_least_squares::{self, Bound};
use planish_fixture::Fixture;
use planish_joint::{JointSettings as Settings, plan};
use planish_schedule::{baselines::pvt_as_published, pvt, pvt::Mode};
use planish_simulate::{
    SimulationSettings::Gridded, deviation::Deviation, error_budget::Scalar, motion::Motion,
    simulate,
};
use planish_testkit::{ion_beam, mirror::Mirror};
use planish_toolpath::{Construction, Scan};
use planish_types::{Limits, MachineFile, Surface, Tif, ToolPath, Trajectory};

use crate::{
    Case,
    paths::{fixture, lines, own_maze, pitches, random, turns},
};

/// Jerk limits of both axes, mm/s^3; none first.
const JERKS_MM_PER_S3: [Option<f64>; 4] = [None, Some(1e5), Some(2e4), Some(5e3)];

/// Floor of the closed loop.
const FLOOR: Bound = Bound::SecondsPerMm(0.02);

/// Natural frequency, Hz, and damping ratio of the servos, and of a structure that follows them.
const SERVOS: [(f64, f64); 5] = [(2.0, 0.7), (5.0, 0.7), (10.0, 0.7), (20.0, 0.7), (6.0, 0.02)];

/// The ion beam machine with this limit on jerk.
fn with_jerk(jerk_mm_per_s3: Option<f64>) -> Limits {
    let mut file = MachineFile::from(&ion_beam());
    file.axes.iter_mut().for_each(|axis| axis.max_jerk_mm_per_s3 = jerk_mm_per_s3);
    file.checked().expect("a machine")
}

fn residual_nm(trajectory: &Trajectory, tif: &Tif, desired: &Surface) -> f64 {
    let prediction = simulate(trajectory, tif, desired, Gridded).expect("a removal");
    prediction.removal.residual().statistics().rms
}

/// The motion of the closed loop, which keeps every limit.
fn closed_loop(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    floor: Bound,
) -> Trajectory {
    let mode = Mode::within(limits);
    let refined = Case { desired, tif, limits, mode, floor, noise_rms_nm: None }.refined(path);
    assert!(refined.iterates[refined.best].limits_respected);
    refined.trajectory
}

/// The joint plan, or why there is none.
fn joint(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
) -> Result<Trajectory, String> {
    let made = plan(desired, tif, path, limits, &Settings::default());
    let made = made.map_err(|e| e.to_string())?;
    made.refused.as_ref().map_or(Ok(()), |why| Err(why.to_string()))?;
    Ok(made.trajectory)
}

fn cells(motion: Result<Trajectory, String>, tif: &Tif, desired: &Surface) -> String {
    match motion {
        Ok(t) => format!(" {:.4} | {:.1} |", residual_nm(&t, tif, desired), t.total_time_s()),
        Err(why) => format!(" {why} | - |"),
    }
}

/// The cost of a limit on jerk: the joint plan along five paths, and the closed loop along two of them.
pub fn limits_on_jerk(reference: &Mirror) {
    let limit = |jerk: Option<f64>| jerk.map_or("no limit".into(), |j| format!("{j:e} mm/s^3"));
    let names = JERKS_MM_PER_S3.map(|jerk| format!(" {}: nm | s |", limit(jerk))).concat();
    println!(
        "\nLimits on jerk, both axes\n\n| path, plan |{names}\n|---|{}",
        "---|---|".repeat(JERKS_MM_PER_S3.len())
    );
    let (desired, tif) = (&reference.desired, &reference.tif);
    let joint_along = |name: &str, desired: &Surface, tif: &Tif, path: &ToolPath| {
        let row = JERKS_MM_PER_S3
            .map(|jerk| cells(joint(desired, tif, path, &with_jerk(jerk)), tif, desired));
        println!("| {name}, joint plan |{}", row.concat());
    };
    let (raster, maze) = (lines(desired, tif, 1.0, Scan::X), own_maze(desired));
    joint_along("raster", desired, tif, &raster);
    joint_along("maze", desired, tif, &maze);
    let random = random(desired, Construction::MeshTree, 1);
    joint_along("random-adaptive", desired, tif, &random);
    joint_along("multi-pitch", desired, tif, &pitches(desired, tif));
    let disk = fixture("disk-100", true);
    let spiral = turns(&disk.surface, &disk.tif, 1.3);
    joint_along("spiral on `disk-100`", &disk.surface, &disk.tif, &spiral);
    for (name, path) in [("raster", &raster), ("maze", &maze)] {
        let row = JERKS_MM_PER_S3.map(|jerk| {
            let motion = closed_loop(desired, tif, path, &with_jerk(jerk), FLOOR);
            cells(Ok(motion), tif, desired)
        });
        println!("| {name}, closed loop |{}", row.concat());
    }
}

/// What axes leave that follow the plans as servos do.
pub fn servos(reference: &Mirror) {
    let (desired, tif) = (&reference.desired, &reference.tif);
    let names = SERVOS.map(|(hz, damping)| format!(" {hz} Hz, {damping} |")).concat();
    println!(
        "\nResidual RMS, nm, after a servo of second order (natural frequency, damping ratio)\n\n\
         | path, plan | s | no servo |{names}\n|---|---|---|{}",
        "---|".repeat(SERVOS.len())
    );
    let row = |name: &str, motion: &Trajectory| {
        let pieces = Motion::new(motion, f64::INFINITY).expect("a motion");
        let after = SERVOS.map(|(hz, damping_ratio)| {
            let mut run = Deviation::default();
            // w = 2 zeta / lag
            let lag_s = damping_ratio / (std::f64::consts::PI * hz);
            run.add(Scalar::ServoSecondOrder { damping_ratio }, lag_s);
            let followed = run.trajectory(&pieces, desired.grid()).expect("a motion");
            format!(" {:.4} |", residual_nm(&followed, tif, desired))
        });
        let (time_s, without) = (motion.total_time_s(), residual_nm(motion, tif, desired));
        println!("| {name} | {time_s:.1} | {without:.4} |{}", after.concat());
    };
    for (name, path) in [("raster", lines(desired, tif, 1.0, Scan::X)), ("maze", own_maze(desired))]
    {
        let (free, limited) = (&with_jerk(None), &with_jerk(Some(2e4)));
        let loops = |limits: &Limits, floor| closed_loop(desired, tif, &path, limits, floor);
        let joint = |limits: &Limits| joint(desired, tif, &path, limits).expect("a plan");
        row(&format!("{name}, joint plan"), &joint(free));
        row(&format!("{name}, joint plan, 2e4 mm/s^3"), &joint(limited));
        row(&format!("{name}, closed loop"), &loops(free, FLOOR));
        row(&format!("{name}, closed loop, 2e4 mm/s^3"), &loops(limited, FLOOR));
        row(&format!("{name}, closed loop, floor 0.1 s"), &loops(free, Bound::Seconds(0.1)));
    }
}

/// The fixtures of the table of modes, with the pitch of their paths, mm.
const FIXTURES: [(&str, f64); 6] = [
    ("coupon", 1.0),
    ("coupon-mixture", 1.0),
    ("coupon-noise", 1.0),
    ("coupon-ring", 1.0),
    ("flat-92x16", 1.0),
    ("disk-100", 1.3),
];

/// Floors of the dwell times of the table of modes: 1 / the largest velocity of the machine, and a slow one.
const FLOORS: [(&str, Bound); 2] =
    [("0.004 s/mm", Bound::SecondsPerMm(0.004)), ("0.1 s", Bound::Seconds(0.1))];

/// Every shape of the PVT motion over the fixtures of these names, or all, without a limit on jerk.
pub fn modes(names: &[String]) {
    println!(
        "| fixture, path, floor | monotone: nm | s | smooth: nm | s | as published: nm | s | refined monotone: nm | s | \
         refined smooth: nm | s |\n|---|---|---|---|---|---|---|---|---|---|---|"
    );
    let limits = &ion_beam();
    for (name, pitch_mm) in FIXTURES {
        if !names.is_empty() && !names.iter().any(|n| n == name) {
            continue;
        }
        let Fixture { surface, tif, .. } = fixture(name, true);
        let mut paths = vec![
            ("raster", lines(&surface, &tif, pitch_mm, Scan::X)),
            ("maze", own_maze(&surface)),
            ("random-adaptive", random(&surface, Construction::MeshTree, 1)),
        ];
        if name == "disk-100" {
            // The others have some 10 000 segments there.
            paths = vec![paths.swap_remove(0), ("spiral", turns(&surface, &tif, pitch_mm))];
        }
        for (path_name, path) in &paths {
            for (floor_name, floor) in FLOORS {
                let row = of_modes(&surface, &tif, path, limits, floor);
                println!("| `{name}`, {path_name}, {floor_name} |{row}");
            }
        }
    }
}

fn of_modes(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    floor: Bound,
) -> String {
    let solver = bounded_least_squares::BoundedSettings { min_dwell: floor, ..Default::default() };
    let solved = bounded_least_squares::solve(desired, tif, path, None, &solver);
    let dwell = solved.expect("a plan").dwell;
    let both = [Mode::Monotone, Mode::Smooth];
    let plain = both.map(|mode| {
        let how = pvt::PvtSettings::new(mode);
        let made = pvt::schedule(path, &dwell, limits, &how);
        cells(made.map(|s| s.trajectory).map_err(|e| e.to_string()), tif, desired)
    });
    let published = pvt_as_published::schedule(
        path,
        &dwell,
        limits,
        &pvt_as_published::AsPublishedSettings::default(),
    );
    let published = cells(published.map(|s| s.trajectory).map_err(|e| e.to_string()), tif, desired);
    let refined = both.map(|mode| {
        let case = Case { desired, tif, limits, mode, floor, noise_rms_nm: None };
        cells(Ok(case.refined(path).trajectory), tif, desired)
    });
    format!("{}{published}{}", plain.concat(), refined.concat())
}
