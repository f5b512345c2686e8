//! A plan, the log of its run, and the residual as run beside the residual as planned: through the programs.

use std::{fmt::Write, fs, path::Path};

use ndarray::Array2;
use planish_handoff::artifact;
use planish_schedule::pvt::{self, Mode};
use planish_testkit::{
    case_generator, ion_beam, mirror,
    program::{text, write},
};
use planish_types::{Axis, DwellTime, Grid, Removal, Surface, Tif, ToolPath, Trajectory};
use rand::RngExt;

/// Runs `planish-<command>` in `dir`; no argument contains a space. The verdict on the residual does not matter
/// here.
fn run(dir: &Path, command: &str) -> String {
    let mut words = command.split_whitespace();
    let program = format!("planish-{}", words.next().unwrap());
    let output =
        planish_testkit::program::stage(&program).args(words).current_dir(dir).output().unwrap();
    let code = output.status.code();
    assert!(matches!(code, Some(0 | 1)), "planish-{command}: {}", text(&output.stderr));
    text(&output.stdout)
}

/// The motion at ascending times since its beginning, with Gaussian noise of `noise_mm`, as a log.
fn log_of(plan: &Trajectory, rate_hz: f64, noise_mm: f64) -> String {
    let mut random = case_generator(1, 17, 0);
    let mut gaussian = || {
        // Box and Muller
        let [u, v]: [f64; 2] = [random.random(), random.random()];
        noise_mm * (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    };
    let breaks = plan.break_time_s();
    let count = (plan.total_time_s() * rate_hz).floor() as usize;
    let mut log = String::from("t_s,x_mm,y_mm\n");
    let mut k = 0;
    for i in 0..=count {
        let t = breaks[0] + i as f64 / rate_hz;
        while k + 1 < plan.len() && breaks[k + 1] <= t {
            k += 1;
        }
        let [x, y] = plan.segment(k).position_mm(t - breaks[k]);
        let [x, y] = [x + gaussian(), y + gaussian()];
        writeln!(log, "{:.7},{x:.7},{y:.7}", i as f64 / rate_hz).unwrap();
    }
    log
}

/// RMS difference of the removal of two motions, by the simulator, nm.
fn apart_nm(dir: &Path, one: &str, other: &str) -> f64 {
    let removal = |name: &str| -> Array2<f64> {
        let out = format!("{name}-removal");
        if !dir.join(&out).exists() {
            run(
                dir,
                &format!("simulate --trajectory {name} --tif tif --surface surface --out {out}"),
            );
        }
        artifact::read::<Removal>(&dir.join(out)).unwrap().value.removal_nm().clone()
    };
    // As every RMS here: without the mean.
    (removal(one) - removal(other)).std(0.0)
}

/// Makes logs of the run of `dwell` along `path`: at 1 kHz with 1 um of noise, and at 20 Hz without noise.
/// Returns the RMS difference of the removal, nm, for the first log, and for the second log with cubic and
/// with straight pieces.
fn as_run(desired: &Surface, tif: &Tif, path: &ToolPath, dwell: &DwellTime) -> [f64; 3] {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "surface", desired);
    write(dir, "tif", tif);
    let plan =
        pvt::schedule(path, dwell, &ion_beam(), &pvt::PvtSettings::new(Mode::Smooth)).unwrap();
    write(dir, "plan", &plan.trajectory);
    fs::write(dir.join("log.csv"), log_of(&plan.trajectory, 1e3, 1e-3)).unwrap();
    let said = run(dir, "import trace log.csv --planned plan --tool-from-plan --out run");
    assert!(said.contains("at 1000 Hz"), "{said}");
    let manifest = artifact::read::<Trajectory>(&dir.join("run")).unwrap().manifest.unwrap();
    for axis in 0..2 {
        let error = &manifest.outcome["following_plan"]["axes"][axis];
        // The noise, in 4e5 samples and less, and no lag beyond some standard errors of the estimate.
        assert!((error["rms_mm"].as_f64().unwrap() - 1e-3).abs() < 3e-5, "{error}");
        let lag = error["lag_ms"].as_f64().unwrap().abs();
        assert!(lag < 5.0 * error["lag_standard_error_ms"].as_f64().unwrap(), "{error}");
    }
    fs::write(dir.join("slow.csv"), log_of(&plan.trajectory, 20.0, 0.0)).unwrap();
    run(dir, "import trace slow.csv --planned plan --tool-from-plan --out slow-cubic");
    run(
        dir,
        "import trace slow.csv --planned plan --tool-from-plan --between linear --out slow-linear",
    );
    let apart = [
        apart_nm(dir, "run", "plan"),
        apart_nm(dir, "slow-cubic", "plan"),
        apart_nm(dir, "slow-linear", "plan"),
    ];
    println!(
        "RMS of the removal as run less as planned: {:.6} nm at 1 kHz with 1 um of noise; at 20 Hz \
         {:.6} nm with cubic and {:.6} nm with straight pieces",
        apart[0], apart[1], apart[2]
    );
    apart
}

#[test]
fn a_log_of_the_reference_mirror_removes_what_was_planned() {
    let Some(mirror) = mirror::mirror() else { return };
    let (path, dwell) = (mirror.path("raster"), mirror.dwell("raster"));
    let [noisy, cubic, linear] = as_run(&mirror.desired, &mirror.tif, &path, &dwell);
    // What is asked for. It is what the noise leaves, 0.00199 nm with this seed: no reader can know better.
    assert!(noisy < 0.002, "{noisy}");
    assert!(cubic < linear, "{cubic} {linear}");
}

/// A map of 12 x 8 mm, a raster of 1 mm along it, dwell times that vary by a factor of three.
#[test]
fn a_log_removes_what_was_planned() {
    let axis = |from: f64, step: f64, n: usize| Axis::new(from, step, n).unwrap();
    let grid = Grid { x: axis(0.0, 0.2, 61), y: axis(0.0, 0.2, 41) };
    let height = |(r, c): (usize, usize)| 20.0 + (0.1 * c as f64).sin() + (0.2 * r as f64).cos();
    let desired = Surface::new(grid, Array2::from_shape_fn(grid.shape(), height)).unwrap();
    let offsets = axis(-4.0, 0.2, 41);
    let rate = |(r, c): (usize, usize)| {
        8.0 * (-(offsets.coordinate_mm(r).powi(2) + offsets.coordinate_mm(c).powi(2)) / 2.0).exp()
    };
    let tif_grid = Grid { x: offsets, y: offsets };
    let tif = Tif::new(tif_grid, Array2::from_shape_fn(tif_grid.shape(), rate)).unwrap();
    let line = |r: i32| (0..=20).map(move |k| [if r % 2 == 0 { k } else { 20 - k } - 4, r - 2]);
    let points: Vec<[f64; 2]> = (0..13).flat_map(line).map(|p| p.map(f64::from)).collect();
    let middle = |w: &[[f64; 2]]| [0, 1].map(|a| 0.5 * (w[0][a] + w[1][a]));
    let middles: Vec<_> = points.windows(2).map(middle).collect();
    let n = middles.len();
    let path = ToolPath::new(points, middles, vec![true; n], vec![0; n]).unwrap();
    let dwell = (0..n).map(|i| 0.2 + 0.1 * (i as f64 * 0.7).sin()).collect();
    let dwell = DwellTime::new(dwell).unwrap();
    let [noisy, cubic, linear] = as_run(&desired, &tif, &path, &dwell);
    assert!(noisy < 0.002, "{noisy}");
    assert!(cubic < linear, "{cubic} {linear}");
}
