//! Dwell-time density as a trigonometric spline: Opt. Express 32 (2024) 9255.

use std::f64::consts::PI;

use ndarray::Array2;
use planish_dwell::{
    baselines::bcls, bounded_least_squares::Bound, columns::Columns, lucy_richardson,
    problem::Problem,
};
use planish_numerics::statistics::{fit_plane, subtract_plane};
use planish_schedule::{
    baselines::average_velocity,
    constant_acceleration,
    interpolator::{Interpolator, Reference, records},
    stop_at_corners,
    trig_spline::{self, TrigPiece as Piece, TrigSplineSchedule as Schedule},
};
use planish_simulate::{SimulationSettings as Settings, simulate};
use planish_surface::psd::{Detrend, Psd, PsdSettings, Window, psd};
use planish_testkit::machine;
use planish_types::{Axis as Pixels, DwellTime, Grid, Limits, Surface, ToolPath, Trajectory};
use planish_verify::{VerifySettings, verify};

use crate::{
    Outcome,
    claim::{Claim, significant},
    figure::{Axis, Series, chart},
    fixture,
    lines::{Spot, lines, lines_in_steps, ripple, uniform},
};

/// The paper's groups of limits (mm/s, mm/s^2); the feeds are 4000 and 12 000 mm/min.
const GROUPS: [(f64, f64); 2] = [(4000.0 / 60.0, 2000.0), (12_000.0 / 60.0, 200.0)];

/// Offsets for the acceleration that the paper adds to the densities 0.015 and 0.005 s/mm of its two
/// groups, s/mm.
const ACCELERATION_OFFSETS: [f64; 2] = [0.0003, 0.00045];

fn limits((velocity, acceleration): (f64, f64)) -> Limits {
    machine([velocity; 2], [acceleration; 2])
}

pub fn reproduce() -> Outcome {
    let part = fixture("disk-100");
    let path = lines(&part.surface, 1.0, 5.0);
    let mut rows = offsets(&part.surface, &path);
    rows.extend(one_piece());
    let (by_method, spectra) = solvers(&part);
    rows.extend(by_method);
    rows.extend(full_run());
    rows.extend(spacing_of_bcls());
    rows.extend(waviness());
    let (more, differences) = overscan(&part);
    rows.extend(more);
    let points = differences.iter().map(|[o, d]| [*o, d.max(1e-4)]).collect();
    let figure = chart(
        &Axis { label: "overscan, mm", ticks: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0], log: false },
        &Axis {
            label: "PV that the offset leaves, nm",
            ticks: vec![1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3],
            log: true,
        },
        &[
            Series {
                name: "the paper: 0.067 nm",
                points: vec![[1.0, 0.067], [6.0, 0.067]],
                dots: false,
            },
            Series { name: "TIF of 4 mm half-size", points, dots: true },
        ],
    );
    let figures = vec![("overscan", figure), ("psd-methods", spectra)];
    Outcome { tables: vec![("trig-spline", rows)], figures }
}

/// Densities proportional to the desired removal, which is 0 at its lowest pixel, so that both
/// limits ask for an offset.
fn offsets(part: &Surface, path: &ToolPath) -> Vec<Claim> {
    let (grid, z) = (part.grid(), part.height_nm());
    let clamp = |v: f64, n: usize| v.round().clamp(0.0, n as f64 - 1.0) as usize;
    let dwell_s = path.dwell_point_mm().iter().enumerate().map(|(i, p)| {
        let c = clamp((p[0] - grid.x.start_mm()) / grid.x.step_mm(), grid.x.len());
        let r = clamp((p[1] - grid.y.start_mm()) / grid.y.step_mm(), grid.y.len());
        let height = if z[[r, c]].is_nan() { 0.0 } else { z[[r, c]] };
        // 0.1 s/mm per micrometre; 1e-6 s where nothing is to be removed
        1e-4 * height * path.segment_length_mm(i) + 1e-6
    });
    let dwell = DwellTime::new(dwell_s.collect()).expect("dwell times");
    let groups: [Schedule; 2] = GROUPS.map(|g| {
        trig_spline::schedule(path, &dwell, &limits(g), &Default::default()).expect("a motion")
    });
    let total = groups
        .each_ref()
        .map(|s| s.report.feed_offset_s_per_mm + s.report.acceleration_offset_s_per_mm);
    let within = groups.iter().zip(GROUPS).all(|(s, g)| {
        let verdict = verify(&s.trajectory, &limits(g), &VerifySettings::default());
        verdict.expect("a verdict").limits_respected
    });
    let use_of = groups.each_ref().map(|s| s.report.acceleration_use);
    // Eqs 10 to 16: an offset delta suffices when (pi |M1| / (2 D A))^(1/3) <= density + delta.
    // The left side goes with A^(-1/3): from 2000 to 200 mm/s^2 the density must grow by 10^(1/3).
    let factor = (GROUPS[0].1 / GROUPS[1].1).cbrt();
    let printed = [0.015 + ACCELERATION_OFFSETS[0], 0.005 + ACCELERATION_OFFSETS[1]];
    // base + printed[1] >= factor (base + printed[0])
    let base = (printed[1] - factor * printed[0]) / (factor - 1.0);
    // With the accelerations exchanged: base + printed[0] >= factor (base + printed[1])
    let base_exchanged = (printed[0] - factor * printed[1]) / (factor - 1.0);
    let [(feed_0, acceleration_0), (feed_1, acceleration_1)] = GROUPS;
    let exchanged = [(feed_0, acceleration_1), (feed_1, acceleration_0)].map(|g| {
        let motion = trig_spline::schedule(path, &dwell, &limits(g), &Default::default());
        let report = motion.expect("a motion").report;
        report.feed_offset_s_per_mm + report.acceleration_offset_s_per_mm
    });
    vec![
        Claim::arithmetic(
            "offset for 4000 mm/min",
            "s/mm",
            0.015,
            groups[0].report.feed_offset_s_per_mm,
            1e-3,
            "1 / feed, where next to nothing is to be removed",
        ),
        Claim::arithmetic(
            "offset for 12 000 mm/min",
            "s/mm",
            0.005,
            groups[1].report.feed_offset_s_per_mm,
            1e-3,
            "as above",
        ),
        Claim::statement(
            "the second group (200 mm/s^2) needs a smaller offset than the first (2000 mm/s^2)",
            "0.00545 against 0.0153 s/mm",
            format!("{} against {} s/mm", significant(total[1], 3), significant(total[0], 3)),
            total[1] < total[0],
        )
        .differs(format!(
            "a tenth of the acceleration asks for {} times the density; with the two accelerations exchanged it \
             does (next row)",
            significant(factor, 3)
        )),
        Claim::check(
            "the same with the two largest accelerations exchanged (200 mm/s^2 at 4000 mm/min, 2000 at 12 000)",
            format!("{} against {} s/mm", significant(exchanged[1], 3), significant(exchanged[0], 3)),
            exchanged[1] < exchanged[0],
        ),
        Claim::statement(
            "a density exists for which both acceleration offsets suffice",
            "assumed",
            format!("its least value would be below {} s/mm", significant(base, 2)),
            base >= 0.0,
        )
        .differs("no density is negative: with the printed accelerations the two offsets exclude each other"),
        Claim::check(
            "the same with the two largest accelerations exchanged",
            format!("its least value is {} s/mm", significant(base_exchanged, 2)),
            base_exchanged >= 0.0,
        )
        .remark("the printed offsets agree with each other then"),
        Claim::statement(
            "feed and acceleration are within the limits everywhere",
            "they are",
            format!(
                "acceleration at most {} of the limit",
                significant(use_of[0].max(use_of[1]), 3)
            ),
            within && use_of.iter().all(|u| *u <= 1.0),
        )
        .remark("exact, and judged on the executed motion"),
    ]
}

/// Eq. 5: the acceleration on one piece, printed and by differences of the feed.
fn one_piece() -> Vec<Claim> {
    let piece = Piece { density_s_per_mm: [0.02, 0.05], length_mm: 0.2 };
    let [d1, d2] = piece.density_s_per_mm;
    let (m1, m2, length) = (d2 - d1, d2 + d1, piece.length_mm);
    // a = dv/dt = v dv/ds by central differences, at 2000 places
    let feed = |x: f64| 1.0 / piece.density_s_per_mm_at(x);
    let step = 1e-5;
    let (mut numeric, mut printed) = (0.0_f64, 0.0_f64);
    for k in 1..2000 {
        let x = f64::from(k) / 2000.0;
        let slope = (feed(x + step) - feed(x - step)) / (2.0 * step * length);
        numeric = numeric.max((feed(x) * slope).abs());
        // Eq. 5: 8 pi D M1 sin u / (M2 + M1 cos u)^3
        let u = PI * (1.0 - x);
        let eq5 = 8.0 * PI * length * m1 * u.sin() / (m2 + m1 * u.cos()).powi(3);
        printed = printed.max(eq5.abs());
    }
    vec![
        Claim::check(
            "peak acceleration in closed form against differences of the feed (0.02 to 0.05 s/mm, 0.2 mm)",
            format!("{} mm/s^2", significant(piece.peak_acceleration(), 4)),
            (piece.peak_acceleration() / numeric - 1.0).abs() < 1e-5,
        ),
        Claim::number(
            "Eq. 5 as printed over the acceleration of that piece",
            "",
            1.0,
            printed / numeric,
            1e-2,
        )
        .differs("the step D belongs into the denominator, 8 should be 4: off by 2 D^2"),
    ]
}

/// Table 2: Lucy-Richardson with the spline, and the same as a plain controller executes it. BCLS has
/// segments as long as it asks for, and is executed with the trapezoidal feeds that it is made for.
fn solvers(part: &planish_fixture::Fixture) -> (Vec<Claim>, String) {
    let path = lines(&part.surface, 2.0, 5.0);
    let (surface, tif) = (&part.surface, &part.tif);
    let problem = Problem {
        desired: surface,
        tif,
        path: &path,
        weight: None,
        columns: Columns::Segment,
        min_dwell: Bound::Seconds(0.0),
    };
    let machine = limits(GROUPS[0]);
    let executed = |t: &Trajectory| {
        let done = simulate(t, tif, surface, Settings::Gridded).expect("a removal");
        let residual = done.removal.residual().clone();
        (residual.statistics().rms, t.total_time_s(), spectrum(&residual))
    };
    let lr = lucy_richardson::solve(&problem, &Default::default()).expect("dwell times");
    let rms = surface.statistics().rms;
    let spline = trig_spline::schedule(&path, &lr.dwell, &machine, &Default::default());
    let proposed = executed(&spline.expect("a motion").trajectory);
    let stopping = stop_at_corners::schedule(&path, &lr.dwell, &machine).expect("a motion");
    let stopping = executed(&stopping.trajectory);
    let plain = constant_acceleration::schedule(&path, &lr.dwell, &machine).expect("a motion");
    let plain = executed(&plain.trajectory);
    // Turns of one segment, and lines in the same steps: none is below the pitch limit.
    let long = lines_in_steps(surface, 2.0, 2.0, 5.0);
    let bounded = bcls::solve(surface, tif, &long, None, &machine, &Default::default());
    let bounded = bounded.expect("dwell times");
    let bounded_model_nm = bounded.solution.report.model_rms_nm;
    let (below, limit_mm) = (bounded.report.below_pitch_limit, bounded.report.pitch_limit_mm);
    let shortest_mm = bounded.report.shortest_segment_mm;
    let trapezoids = stop_at_corners::schedule(&long, &bounded.solution.dwell, &machine);
    let bounded = executed(&trapezoids.expect("a motion").trajectory);
    let kept = proposed.0 / lr.outcome.model_rms_nm;
    let band_nm = [&proposed, &stopping, &plain, &bounded].map(|of| of.2.report.bands[0].rms_nm);
    let figure = spectra_figure([&proposed.2, &stopping.2, &plain.2, &bounded.2]);
    let rows = vec![
        Claim::statement(
            "convergence of Lucy-Richardson with the spline (1 - residual / initial RMS)",
            "97.57 % (experiment)",
            format!(
                "{} %; {} times the residual of the plan",
                significant(100.0 * (1.0 - proposed.0 / rms), 3),
                significant(kept, 3)
            ),
            proposed.0 < 0.05 * rms && kept < 1.05,
        )
        .remark("another part; the spline executes what was planned"),
        Claim::statement(
            "the same dwell times as a plain controller executes them leave more (stopping at corners, constant acceleration)",
            "they do (Table 2)",
            format!(
                "{} and {} nm against {} nm",
                significant(stopping.0, 3),
                significant(plain.0, 3),
                significant(proposed.0, 3)
            ),
            proposed.0 < stopping.0 && proposed.0 < plain.0,
        )
        .remark("hardly: the density has no step at the edge of the reach that such a controller would overshoot"),
        Claim::check(
            "BCLS on segments that its pitch limit allows (RMS in its own model, and by trapezoidal feeds)",
            format!("{} and {} nm", significant(bounded_model_nm, 3), significant(bounded.0, 3)),
            below == 0 && shortest_mm >= limit_mm && bounded_model_nm < bounded.0,
        ),
        Claim::statement(
            "converges further than BCLS, each executed by what it is meant for",
            "it does (Table 2)",
            format!("{} against {} nm RMS", significant(proposed.0, 3), significant(bounded.0, 3)),
            proposed.0 < bounded.0,
        ),
        Claim::check(
            "time of the two on the machine",
            format!("{} and {} s", significant(proposed.1, 4), significant(bounded.1, 4)),
            (proposed.1 / bounded.1 - 1.0).abs() < 0.2,
        )
        .remark("the offset and a map that has to be positive cost the spline more"),
        Claim::statement(
            "what is left at 0.02 to 0.2 /mm is least with the spline (Lucy-Richardson by the spline, by stopping at corners, by constant acceleration; BCLS by trapezoids)",
            "it is (Fig. 12)",
            format!("{} nm", band_nm.map(|v| significant(v, 3)).join(" / ")),
            band_nm[1..].iter().all(|other| band_nm[0] <= *other),
        ),
    ];
    (rows, figure)
}

/// Spectrum of the residual over the inscribed square of the disk.
fn spectrum(residual: &Surface) -> Psd {
    let settings = PsdSettings {
        window: Window::Hann,
        detrend: Detrend::Plane,
        band_per_mm: vec![[0.02, 0.2]],
    };
    psd(residual, &settings).expect("a spectrum")
}

/// Fig. 12: radial spectra of the residuals, by method.
fn spectra_figure(spectra: [&Psd; 4]) -> String {
    let names = [
        "Lucy-Richardson, spline",
        "Lucy-Richardson, stopping at corners",
        "Lucy-Richardson, constant acceleration",
        "BCLS, trapezoids",
    ];
    let series = names.into_iter().zip(spectra).map(|(name, s)| {
        let points = s.frequency_radial_per_mm.iter().zip(&s.psd_radial_nm2_mm2);
        let points = points.filter(|(f, _)| (0.01..=1.0).contains(*f));
        Series { name, points: points.map(|(f, d)| [*f, *d]).collect(), dots: false }
    });
    chart(
        &Axis { label: "spatial frequency, 1/mm", ticks: vec![0.01, 0.1, 1.0], log: true },
        &Axis {
            label: "density of what is left, nm^2 mm^2",
            ticks: (-6..=4).step_by(2).map(|k| 10.0_f64.powi(k)).collect(),
            log: true,
        },
        &series.collect::<Vec<_>>(),
    )
}

/// The source's set-up: 1641 x 1641 pixels, lines and steps D = 0.2 mm apart, the first group of limits.
fn full_run() -> Vec<Claim> {
    let part = fixture("disk-100-1641");
    let (surface, tif) = (&part.surface, &part.tif);
    let path = lines_in_steps(surface, 0.2, 0.2, 5.0);
    let problem = Problem {
        desired: surface,
        tif,
        path: &path,
        weight: None,
        columns: Columns::Segment,
        min_dwell: Bound::Seconds(0.0),
    };
    let settings = lucy_richardson::LucyRichardsonSettings {
        unknowns: lucy_richardson::Unknowns::Map,
        max_iterations: 60,
        stop_at_max: true,
        ..Default::default()
    };
    let lr = lucy_richardson::solve(&problem, &settings).expect("dwell times");
    let machine = limits(GROUPS[0]);
    let spline = trig_spline::schedule(&path, &lr.dwell, &machine, &Default::default());
    let spline = spline.expect("a motion");
    let offset = spline.report.feed_offset_s_per_mm + spline.report.acceleration_offset_s_per_mm;
    let kept = verify(&spline.trajectory, &machine, &VerifySettings::default());
    let kept = kept.expect("a verdict").limits_respected;
    // The planned feed, which no machine follows.
    let free = planish_testkit::machine([1e9; 2], [1e12; 2]);
    let ideal = average_velocity::schedule(&path, &lr.dwell, &free).expect("a motion");
    let [done, ideal] = [&spline.trajectory, &ideal.trajectory]
        .map(|t| simulate(t, tif, surface, Settings::Gridded).expect("a removal").removal);
    let apart = done.removal_nm() - ideal.removal_nm();
    let apart_nm = pv_nm(surface, apart, EDGE_MM);
    let (ticks, error_mm) = interpolated(&spline);
    let (rms, before) = (done.residual().statistics().rms, surface.statistics().rms);
    vec![
        Claim::statement(
            "offset on the source's set-up (1641 x 1641 px, lines and steps of 0.2 mm): at most a third more than the feed alone asks for",
            "0.0153 s/mm",
            format!("{} s/mm", significant(offset, 3)),
            offset <= MOST_OFFSET / GROUPS[0].0,
        )
        .remark(format!(
            "another part; {} segments, {} s, of which the offset adds {} s",
            path.len(),
            significant(spline.trajectory.total_time_s(), 4),
            significant(spline.report.offset_added_s, 3)
        )),
        Claim::statement(
            "that run converges, within the limits (1 - residual / initial RMS)",
            "97.57 % (experiment)",
            format!("{} %", significant(100.0 * (1.0 - rms / before), 3)),
            kept && rms < 0.05 * before,
        )
        .remark("another part"),
        Claim::statement(
            "ideal and repaired feed of that run remove the same but for a piston (PV without 2 mm at the edge)",
            "0.067 nm",
            format!("{} nm", significant(apart_nm, 2)),
            apart_nm < 2.0 * 0.067,
        )
        .remark("another part and tool"),
        Claim::check(
            "the real-time interpolator on that run, a tick per millisecond: largest distance from the motion that is judged",
            format!("{} mm", significant(error_mm, 2)),
            error_mm <= trig_spline::TrigSplineSettings::default().fit_tolerance_mm,
        )
        .remark(format!("{:.3e} positions; they are on the spline but for rounding, the motion is fitted to it within 1e-6 mm", ticks as f64)),
    ]
}

/// Number of positions that the real-time interpolator gives, and their largest distance from the motion,
/// mm.
fn interpolated(schedule: &Schedule) -> (usize, f64) {
    let density = schedule.density.as_ref().expect("a path with a length");
    let trajectory = &schedule.trajectory;
    // The interpolator begins at the feed of the first pass, the motion with the run-up to it.
    let begin_s = (0..trajectory.len())
        .find(|k| trajectory.tool_on()[*k])
        .map_or(0.0, |k| trajectory.break_time_s()[k]);
    let (mut k, mut count, mut largest) = (0, 0, 0.0_f64);
    let mut compare = |r: Reference| {
        let time_s = begin_s + r.time_s;
        let last = trajectory.len() - 1;
        while k < last && trajectory.break_time_s()[k + 1] <= time_s {
            k += 1;
        }
        let segment = trajectory.segment(k);
        let p = segment.position_mm(time_s - segment.start_s);
        largest = largest.max((p[0] - r.position_mm[0]).hypot(p[1] - r.position_mm[1]));
        count += 1;
    };
    let mut interpolator = Interpolator::new(1e-3).expect("a tick");
    for record in records(density) {
        interpolator.push(&record, &mut compare).expect("blocks that join");
    }
    (count, largest)
}

/// Largest offset of the density for which the claim holds, in units of 1 / feed: 0.02 s/mm at 4000 mm/min.
/// Larger: a weaker claim. Smaller: another part may fail it.
const MOST_OFFSET: f64 = 4.0 / 3.0;

/// PV of a map on the part, the plane removed, without `cut_mm` at the edge of its disk.
fn pv_nm(part: &Surface, mut z: Array2<f64>, cut_mm: f64) -> f64 {
    let (x, y) = (part.grid().x, part.grid().y);
    let middle = [x, y].map(|a| 0.5 * (a.start_mm() + a.end_mm()));
    let radius_mm = 0.5 * (x.end_mm() - x.start_mm()) - cut_mm;
    for ((at, z), m) in z.indexed_iter_mut().zip(part.height_nm()) {
        let (dx, dy) = (x.coordinate_mm(at.1) - middle[0], y.coordinate_mm(at.0) - middle[1]);
        if m.is_nan() || cut_mm > 0.0 && dx.hypot(dy) > radius_mm {
            *z = f64::NAN;
        }
    }
    let (x, y) = (x.coordinates(), y.coordinates());
    let plane = fit_plane(z.view(), &x, &y).expect("a plane");
    let z = subtract_plane(z.view(), &x, &y, plane);
    let valid = z.iter().filter(|v| !v.is_nan());
    let (low, high) = valid.fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    high - low
}

/// Reachable feed of BCLS in one step, and the step that reaches the largest feed.
fn spacing_of_bcls() -> Vec<Claim> {
    let line: Vec<[f64; 2]> = (0..=20).map(|i| [0.2 * f64::from(i), 0.0]).collect();
    let path = ToolPath::through(line, vec![true; 20], vec![0; 20]).expect("a path");
    let axis = |n| Pixels::new(-4.0, 0.2, n).expect("an axis");
    let grid = Grid { x: axis(61), y: axis(41) };
    let part = Surface::new(grid, Array2::from_shape_fn(grid.shape(), |(_, c)| 10.0 + c as f64));
    let part = part.expect("a map");
    let tif = Spot(vec![(10.0, 0.5)]).on(0.2);
    let report = bcls::solve(&part, &tif, &path, None, &limits(GROUPS[0]), &Default::default());
    let report = report.expect("dwell times").report;
    vec![
        Claim::arithmetic(
            "BCLS: least step that reaches 4000 mm/min",
            "mm",
            1.11,
            report.pitch_limit_mm,
            2e-3,
            "V^2 / (2 A)",
        ),
        Claim::arithmetic(
            "BCLS: largest feed in a step of 0.2 mm",
            "mm/s",
            28.3,
            report.reachable_mm_per_s[1],
            2e-3,
            "sqrt(2 d A)",
        ),
    ]
}

/// Eq. 18, and the ripple of lines 0.8 mm apart.
fn waviness() -> Vec<Claim> {
    let spot = Spot(vec![(10.0, 0.35), (4.0, 0.6)]);
    let (pitch, density) = (0.8, 2.0);
    let profile = spot.simulated(pitch, density);
    let mean = profile.iter().map(|p| p[1]).sum::<f64>() / profile.len() as f64;
    let off = profile.iter().map(|[y, z]| (z - spot.removal_nm(pitch, density, *y)).abs());
    let off = off.fold(0.0, f64::max) / mean;
    let n = 256;
    let axis = |n| Pixels::new(0.0, 0.05, n).expect("an axis");
    let grid = Grid { x: axis(16), y: axis(n) };
    let first = (profile.len() - n) / 2;
    let map = Array2::from_shape_fn(grid.shape(), |(r, _)| profile[first + r][1]);
    let settings =
        PsdSettings { window: Window::Hann, detrend: Detrend::Mean, band_per_mm: Vec::new() };
    let spectrum = psd(&Surface::new(grid, map).expect("a map"), &settings).expect("a spectrum");
    let highest = spectrum
        .frequency_y_per_mm
        .iter()
        .zip(&spectrum.psd_y_nm2_mm)
        .max_by(|a, b| a.1.total_cmp(b.1))
        .map_or(0.0, |(f, _)| *f);
    vec![
        Claim::arithmetic(
            "spatial frequency of the ripple of lines 0.8 mm apart",
            "1/mm",
            1.25,
            highest,
            0.02,
            "1 / pitch",
        ),
        Claim::statement(
            "Eq. 18: the waviness of two Gaussians, against the simulated one",
            "the formula",
            if off < 1e-5 { "within 1e-5 of the mean removal".into() } else { significant(off, 2) },
            off < 1e-5,
        )
        .remark(if ripple(&profile, pitch) > 1e-2 {
            "ripple above 1 % of the mean"
        } else {
            "flat"
        }),
    ]
}

/// Width of the edge that the paper leaves out, mm.
const EDGE_MM: f64 = 2.0;

/// Residual inside the aperture after an offset of all densities, against the overscan.
fn overscan(part: &planish_fixture::Fixture) -> (Vec<Claim>, Vec<[f64; 2]>) {
    let surface = &part.surface;
    // Without `cut_mm` at the edge of the disk.
    let left_nm = |overscan_mm: f64, cut_mm: f64| {
        let path = lines(surface, 0.5, overscan_mm);
        pv_nm(surface, uniform(surface, &part.tif, &path, 0.0153), cut_mm)
    };
    let found: Vec<[f64; 2]> =
        [1.0, 2.0, 3.0, 4.0, 5.0, 6.0].map(|o| [o, left_nm(o, 0.0)]).to_vec();
    let without_edge = left_nm(1.0, EDGE_MM);
    let rows = vec![
        Claim::elsewhere("PV that the offset of 0.0153 s/mm leaves, overscan 5 mm", "nm", 0.067, found[4][1], 0.5)
            .remark("another part and tool; a piston where the path goes beyond by the TIF's half-size (4 mm), and what is left is the ripple of the lines"),
        Claim::elsewhere(
            "the same, overscan 1 mm, without 2 mm at the edge, as the paper has it (without edge effect)",
            "nm",
            0.067,
            without_edge,
            0.5,
        )
        .differs("our TIF reaches 4 mm, beyond the path and the cut together"),
        Claim::check(
            "the same, overscan 1 mm, with the edge",
            format!("{} nm", significant(found[0][1], 3)),
            found[0][1] > 10.0 * without_edge,
        )
        .remark("the edge is removed less than the middle; the paper leaves it out"),
    ];
    (rows, found)
}
