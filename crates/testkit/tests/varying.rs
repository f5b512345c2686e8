//! Plans for tools that are not the same everywhere, judged by a sum over the motion of the tool itself: not by its
//! kernels and weights.

use ndarray::{Array2, Zip};
use planish_dwell::{
    baselines::{bcls, feed_law, non_negative_least_squares as nnls, truncated_svd},
    bounded_least_squares::{self as squares, Bound},
    columns::Columns,
    lucy_richardson,
    problem::Problem,
    rifta, tikhonov_lsqr, udo,
};
use planish_fixture::{Recipe, make};
use planish_form::Form;
use planish_testkit::{ion_beam, workspace};
use planish_tool::varying::{
    Carrier, Direction, Footprint, LowRankSettings, Overhang, Parameter, Places, PressureLaw,
    RateLaw, Spots, ToolFrame, low_rank, low_rank_by_azimuth, low_rank_by_heading, tool_at, turned,
};
use planish_toolpath::{
    OnForm,
    maze::{MazeSettings, Tree, maze},
    raster::{RasterSettings, raster},
};
use planish_types::{
    Axis, Grid, PixelFactor, Pose, Surface, Tif, TimeFactor, ToolPath, Trajectory, VaryingTif,
};

fn coupon() -> (Surface, Tif, ToolPath) {
    let text = std::fs::read_to_string(workspace().join("fixtures/coupon.json")).unwrap();
    let recipe: Recipe = serde_json::from_str(&text).unwrap();
    let made = make(&recipe).unwrap();
    let path = raster(&made.surface, &RasterSettings::new(1.0, 1.0, 3.0)).unwrap();
    (made.surface, made.tif, path)
}

/// A Gaussian whose peak and width change over the part: nm/s at the offset u of a tool at p.
fn gaussian(p: [f64; 2], u: [f64; 2]) -> f64 {
    let sigma = 1.0 + 0.012 * (p[0] - 10.0);
    let peak = 10.0 * (1.0 + 0.03 * (p[1] - 6.0) - 0.015 * (p[0] - 10.0));
    peak * (-(u[0] * u[0] + u[1] * u[1]) / (2.0 * sigma * sigma)).exp()
}

/// Kernels and weights of a function of place and offset.
fn tool(tif: &Tif, error: f64, k: impl Fn([f64; 2], [f64; 2]) -> f64 + Sync) -> Tif {
    let offsets = *tif.grid();
    let of = |p: [f64; 2]| {
        Array2::from_shape_fn(offsets.shape(), |(r, c)| {
            k(p, [offsets.x.coordinate_mm(c), offsets.y.coordinate_mm(r)])
        })
    };
    let settings = LowRankSettings { error, max_rank: 20 };
    let rectangle = [[-4.0, -4.0], [24.0, 16.0]];
    let found = low_rank(&offsets, (rectangle, None), &of, &|_| true, &settings).unwrap();
    assert!(found.report.negative().is_none(), "{:?}", found.report);
    Tif::varying(found.tool).unwrap()
}

/// RMS (mean removed) of what a motion leaves, by the tool itself at `steps` places of every segment.
fn left_nm(
    trajectory: &Trajectory,
    desired: &Surface,
    steps: usize,
    half_mm: f64,
    k: impl Fn([f64; 2], [f64; 2], f64) -> f64 + Sync,
) -> f64 {
    left_of_turning_nm(trajectory, desired, steps, half_mm, |p, u, t, _| k(p, u, t))
}

/// The same of a tool that is told the direction of its motion too, a unit vector.
fn left_of_turning_nm(
    trajectory: &Trajectory,
    desired: &Surface,
    steps: usize,
    half_mm: f64,
    k: impl Fn([f64; 2], [f64; 2], f64, [f64; 2]) -> f64 + Sync,
) -> f64 {
    let grid = desired.grid();
    let mut left = desired.height_nm().clone();
    for s in trajectory.segments().filter(|s| s.tool_on) {
        let h = s.duration_s / steps as f64;
        for q in 0..steps {
            let u_s = (q as f64 + 0.5) * h;
            let (p, t) = (s.position_mm(u_s), s.start_s + u_s);
            let [from, to] = [-0.25, 0.25].map(|part| s.position_mm(u_s + part * h));
            let way = [to[0] - from[0], to[1] - from[1]];
            let direction = way.map(|d| d / way[0].hypot(way[1]));
            for ((r, c), z) in left.indexed_iter_mut() {
                let u = [grid.x.coordinate_mm(c) - p[0], grid.y.coordinate_mm(r) - p[1]];
                if u[0].abs() <= half_mm && u[1].abs() <= half_mm {
                    *z -= h * k(p, u, t, direction);
                }
            }
        }
    }
    rms(&left)
}

fn rms(map: &Array2<f64>) -> f64 {
    let valid = || map.iter().filter(|z| !z.is_nan());
    let count = valid().count() as f64;
    let mean = valid().sum::<f64>() / count;
    (valid().map(|z| (z - mean).powi(2)).sum::<f64>() / count).sqrt()
}

/// The motion of dwell times at a uniform feedrate in every segment.
fn at_uniform_feed(path: &ToolPath, dwell_s: &[f64]) -> Trajectory {
    let mut breaks = vec![0.0];
    let (mut c, mut on, mut index) = (vec![], vec![], vec![]);
    for (j, t) in dwell_s.iter().enumerate().filter(|(_, t)| **t > 0.0) {
        let (start, d) = (path.point_mm()[j], path.displacement_mm(j));
        c.push([0, 1].map(|a| [start[a], d[a] / t, 0.0, 0.0]));
        breaks.push(breaks[breaks.len() - 1] + t);
        on.push(path.tool_on()[j]);
        index.push(Some(j));
    }
    Trajectory::new(breaks, c, on, index).unwrap()
}

fn settings(most_factorised: usize) -> squares::BoundedSettings {
    squares::BoundedSettings {
        max_factorised_points: most_factorised,
        ..squares::BoundedSettings::default()
    }
}

/// The motion of the joint plan.
fn joint(desired: &Surface, tif: &Tif, path: &ToolPath) -> Trajectory {
    let settings = planish_joint::JointSettings::default();
    planish_joint::plan(desired, tif, path, &ion_beam(), &settings).unwrap().trajectory
}

/// The motion of the closed loop.
fn refined(desired: &Surface, tif: &Tif, path: &ToolPath) -> Trajectory {
    let mut settings = planish_refine::RefineSettings::default();
    settings.dwell.min_dwell = Bound::SecondsPerMm(0.02);
    planish_refine::refine(desired, tif, path, &ion_beam(), None, &settings).unwrap().trajectory
}

#[test]
fn bounded_least_squares_know_the_tool_and_prove_it_at_all_sizes() {
    let (desired, tif, path) = coupon();
    let varying = tool(&tif, 1e-4, gaussian);
    let constant = squares::solve(&desired, &tif, &path, None, &settings(6000)).unwrap();
    let judged = |dwell: &[f64], varies: bool| {
        let k = |p: [f64; 2], u: [f64; 2], _: f64| {
            if varies { gaussian(p, u) } else { gaussian([10.0, 6.0], u) }
        };
        left_nm(&at_uniform_feed(&path, dwell), &desired, 6, 3.5, k)
    };
    let of_constant = judged(constant.dwell.dwell_s(), false);
    let ignoring = judged(constant.dwell.dwell_s(), true);
    let mut left = vec![];
    // Factorised, and by the two-level method.
    for most in [6000, 10] {
        let found = squares::solve(&desired, &varying, &path, None, &settings(most)).unwrap();
        let report = &found.report;
        // The gap that the settings ask for.
        assert!(
            report.proven.relative_gap.unwrap() <= 1e-4,
            "{most}: {:?}",
            report.proven.relative_gap
        );
        let known = judged(found.dwell.dwell_s(), true);
        println!("constant {of_constant:.4} nm, known {known:.4} nm, ignored {ignoring:.4} nm");
        // A tool of a standard deviation up to 1.15 mm for 1.0 resolves less; the issue is what is ignored.
        assert!(known <= 1.1 * of_constant, "{most}: {known} {of_constant}");
        assert!(ignoring > 5.0 * known, "{ignoring} {known}");
        left.push(known);
    }
    // Objectives within 1e-4 of the least one have residuals within 1e-2 of each other.
    assert!((left[0] / left[1] - 1.0).abs() < 1e-2, "{left:?}");
}

#[test]
fn a_factor_of_the_pixels_is_known_at_all_sizes() {
    let (desired, tif, path) = coupon();
    // A beam on a cylinder whose edge is at 30 degrees.
    let incidence = |x: f64| ((x - 10.0) / 20.0).asin();
    let law = RateLaw::Cosine { exponent: -1.7 };
    let grid = *desired.grid();
    let factor = Array2::from_shape_fn(grid.shape(), |(_, c)| {
        law.factor(incidence(grid.x.coordinate_mm(c)).to_degrees())
    });
    let one = VaryingTif {
        offsets: *tif.grid(),
        kernels: vec![tif.rate_nm_per_s().clone()],
        positions: grid,
        weights: vec![Array2::ones(grid.shape())],
        azimuth: None,
        heading: None,
        pixels: Some(PixelFactor { grid, factor: factor.clone() }),
        time: None,
    };
    let varying = Tif::varying(one).unwrap();
    let of = |dwell: &[f64], known: bool| {
        let motion = at_uniform_feed(&path, dwell);
        let k = |p: [f64; 2], u: [f64; 2], _: f64| {
            let x = p[0] + u[0];
            let g = if known { incidence(x).cos().powf(-1.7) } else { 1.0 };
            g * gaussian([10.0, 6.0], u)
        };
        left_nm(&motion, &desired, 6, 3.5, k)
    };
    let constant = squares::solve(&desired, &tif, &path, None, &settings(6000)).unwrap();
    let of_constant = of(constant.dwell.dwell_s(), false);
    for most in [6000, 10] {
        let found = squares::solve(&desired, &varying, &path, None, &settings(most)).unwrap();
        let gap = found.report.proven.relative_gap.unwrap();
        // The gap that the settings ask for.
        assert!(gap <= 1e-4, "{most}: {gap}");
        let known = of(found.dwell.dwell_s(), true);
        assert!(known <= 1.1 * of_constant, "{most}: {known} {of_constant}");
    }
    assert!(of(constant.dwell.dwell_s(), true) > 2.0 * of_constant);
}

#[test]
fn other_solvers_use_the_tool_or_refuse_it() {
    let (desired, tif, path) = coupon();
    let varying = tool(&tif, 1e-4, gaussian);
    let problem = Problem {
        desired: &desired,
        tif: &varying,
        path: &path,
        weight: None,
        columns: Columns::Segment,
        min_dwell: Bound::Seconds(0.0),
    };
    let judged = |dwell: &[f64]| {
        left_nm(&at_uniform_feed(&path, dwell), &desired, 6, 3.5, |p, u, _| gaussian(p, u))
    };
    let before = rms(desired.height_nm());
    let found = [
        ("lsqr", tikhonov_lsqr::solve(&problem, &Default::default()).map(|s| s.dwell)),
        ("svd", truncated_svd::solve(&problem, &Default::default()).map(|s| s.dwell)),
        ("nnls", nnls::solve(&problem, &Default::default()).map(|s| s.dwell)),
        ("lucy", lucy_richardson::solve(&problem, &Default::default()).map(|s| s.dwell)),
        (
            "bcls",
            bcls::solve(&desired, &varying, &path, None, &ion_beam(), &Default::default())
                .map(|s| s.solution.dwell),
        ),
    ];
    for (name, dwell) in found {
        let left = judged(dwell.unwrap().dwell_s());
        println!("{name}: {left:.4} of {before:.4} nm");
        // Ignored, the tool leaves more than a tenth.
        assert!(left < 0.1 * before, "{name}: {left} of {before}");
    }
    let on_map = lucy_richardson::LucyRichardsonSettings {
        unknowns: lucy_richardson::Unknowns::Map,
        ..Default::default()
    };
    let refused = [
        udo::solve(&problem, &Default::default()).map(|_| ()).unwrap_err(),
        rifta::solve(&problem, &Default::default()).map(|_| ()).unwrap_err(),
        feed_law::solve(&problem, &Default::default()).map(|_| ()).unwrap_err(),
        lucy_richardson::solve(&problem, &on_map).map(|_| ()).unwrap_err(),
    ];
    for e in refused {
        assert!(e.to_string().contains("varies over the part"), "{e}");
    }
}

#[test]
fn the_joint_plan_and_the_closed_loop_know_the_tool() {
    let (desired, tif, path) = coupon();
    let varying = tool(&tif, 1e-4, gaussian);
    let judged =
        |t: &Trajectory, varies: bool| {
            left_nm(t, &desired, 8, 3.5, |p, u, _| {
                if varies { gaussian(p, u) } else { gaussian([10.0, 6.0], u) }
            })
        };
    let joint = |tif: &Tif| joint(&desired, tif, &path);
    let refined = |tif: &Tif| refined(&desired, tif, &path);
    // The closed loop ends where single segments decide, and a wider tool makes it end up to a third higher.
    for (plan, most) in [(&joint as &dyn Fn(&Tif) -> Trajectory, 1.1), (&refined, 1.35)] {
        let (constant, known) = (judged(&plan(&tif), false), judged(&plan(&varying), true));
        let ignored = judged(&plan(&tif), true);
        println!("constant {constant:.4}, known {known:.4}, ignored {ignored:.4} nm");
        assert!(known <= most * constant, "{known} {constant}");
        assert!(ignored > 3.0 * known, "{ignored} {known}");
    }
}

#[test]
fn a_rate_that_falls_in_a_known_way_costs_nothing() {
    let (desired, tif, path) = coupon();
    // 10 % over the run of about 200 s.
    let law = TimeFactor { time_s: vec![0.0, 200.0], factor: vec![1.0, 0.9] };
    let given = VaryingTif {
        offsets: *tif.grid(),
        kernels: vec![tif.rate_nm_per_s().clone()],
        positions: *desired.grid(),
        weights: vec![Array2::ones(desired.grid().shape())],
        azimuth: None,
        heading: None,
        pixels: None,
        time: Some(law.clone()),
    };
    let wears = Tif::varying(given).unwrap();
    let judged = |t: &Trajectory, falls: bool| {
        left_nm(t, &desired, 8, 3.5, |_, u, t_s| {
            let c = if falls { 1.0 - 0.1 * (t_s / 200.0).min(1.0) } else { 1.0 };
            c * gaussian([10.0, 6.0], u)
        })
    };
    let dwell = |tif: &Tif| {
        let found = squares::solve(&desired, tif, &path, None, &settings(6000)).unwrap();
        at_uniform_feed(&path, found.dwell.dwell_s())
    };
    let joint = |tif: &Tif| joint(&desired, tif, &path);
    let refined = |tif: &Tif| refined(&desired, tif, &path);
    for plan in [&dwell as &dyn Fn(&Tif) -> Trajectory, &joint, &refined] {
        let (constant, known) = (judged(&plan(&tif), false), judged(&plan(&wears), true));
        println!("constant {constant:.4}, known {known:.4} nm");
        assert!(known <= 1.05 * constant, "{known} {constant}");
    }
}

/// A spot that is wide across its motion, whose peak trails the tool, in nm/s at the offset u, in a motion along a direction.
fn steered(u: [f64; 2], direction: [f64; 2]) -> f64 {
    let along = u[0] * direction[0] + u[1] * direction[1] + 0.4;
    let across = u[1] * direction[0] - u[0] * direction[1];
    8.0 * (-0.5 * ((along / 0.8).powi(2) + (across / 1.2).powi(2))).exp()
}

#[test]
fn a_spot_that_turns_with_the_motion_is_known_on_lines_there_and_back_and_on_a_maze() {
    let (desired, _, raster) = coupon();
    let step = Axis::new(-6.0, 0.25, 49).unwrap();
    let offsets = Grid { x: step, y: step };
    let along_x = |(r, c): (usize, usize)| {
        steered([offsets.x.coordinate_mm(c), offsets.y.coordinate_mm(r)], [1.0, 0.0])
    };
    let fixed = Tif::new(offsets, Array2::from_shape_fn(offsets.shape(), along_x)).unwrap();
    let exact = LowRankSettings { error: 3e-3, max_rank: 40 };
    let (offsets, of) = turned(&fixed, [0.0; 2]).unwrap();
    let found = low_rank_by_heading(&offsets, *desired.grid(), &*of, &exact).unwrap();
    assert!(found.report.negative().is_none(), "{:?}", found.report);
    let turning = Tif::varying(found.tool).unwrap();
    let settings_of_maze = MazeSettings {
        pitch_mm: 1.0,
        step_mm: 0.5,
        overscan_mm: 3.0,
        corner_radius_mm: 0.5,
        tree: Tree::Wilson,
        open: true,
        seed: 3,
    };
    let maze = maze(&desired, &settings_of_maze).unwrap().path;
    let judged = |t: &Trajectory, turns: bool| {
        left_of_turning_nm(t, &desired, 8, 6.0, |_, u, _, direction| {
            steered(u, if turns { direction } else { [1.0, 0.0] })
        })
    };
    let dwell = |tif: &Tif, path: &ToolPath| {
        let found = squares::solve(&desired, tif, path, None, &settings(6000)).unwrap();
        at_uniform_feed(path, found.dwell.dwell_s())
    };
    let joint = |tif: &Tif, path: &ToolPath| joint(&desired, tif, path);
    let refined = |tif: &Tif, path: &ToolPath| refined(&desired, tif, path);
    type Plan<'a> = &'a dyn Fn(&Tif, &ToolPath) -> Trajectory;
    let plans: [(&str, Plan<'_>, &ToolPath); 4] = [
        ("raster, bounded least squares", &dwell, &raster),
        ("raster, joint plan", &joint, &raster),
        ("maze, joint plan", &joint, &maze),
        ("maze, closed loop", &refined, &maze),
    ];
    for (name, of, path) in plans {
        let of_fixed = of(&fixed, path);
        let (constant, ignored) = (judged(&of_fixed, false), judged(&of_fixed, true));
        let known = judged(&of(&turning, path), true);
        println!("{name}: constant {constant:.4}, known {known:.4}, ignored {ignored:.4} nm");
        // The goal for a spot that turns with the azimuth; the ignored one leaves 3.6 to 35 times as much.
        assert!(known <= 1.2 * constant, "{name}: {known} {constant}");
        assert!(ignored > 3.0 * known, "{name}: {ignored} {known}");
    }
}

#[test]
fn low_rank_is_the_tool_to_the_stated_error() {
    let (_, tif, _) = coupon();
    let offsets = *tif.grid();
    for error in [1e-2, 1e-3, 1e-4] {
        let varying = tool(&tif, error, gaussian);
        let mut worst = (0.0_f64, 0.0_f64);
        let (mut squares, mut missed) = (0.0, 0.0);
        for k in 0..200 {
            let p = [
                (0.37 * f64::from(k)).fract() * 28.0 - 4.0,
                (0.71 * f64::from(k)).fract() * 20.0 - 4.0,
            ];
            for ((r, c), _) in tif.rate_nm_per_s().indexed_iter().step_by(17) {
                let u = [offsets.x.coordinate_mm(c), offsets.y.coordinate_mm(r)];
                let (exact, found) = (gaussian(p, u), varying.rate_of_tool_at(Pose::along_x(p), u));
                squares += exact * exact;
                missed += (exact - found).powi(2);
                worst = (worst.0.max((exact - found).abs()), worst.1.max(exact));
            }
        }
        let relative = f64::sqrt(missed / squares);
        println!("{error:e}: {relative:.2e}, largest {:.2e} of the peak", worst.0 / worst.1);
        // Measured at other places than those of the report.
        assert!(relative <= 1.5 * error, "{error}: {relative}");
    }
}

/// A sphere of 34 mm about the middle of the coupon is up to 20 degrees steep.
#[test]
fn a_tool_along_the_normal_of_a_sphere_leaves_no_more_than_on_a_flat_part() {
    const RADIUS_MM: f64 = 34.0;
    let (desired, tif, path) = coupon();
    let form = Form::sphere(RADIUS_MM, [10.0, 6.0]).unwrap();
    let places = Places::new(&desired).with_form(form.clone()).unwrap();
    let foot = Footprint::new(
        &tif,
        &places,
        Direction::Normal(Box::new(ToolFrame::of_carrier(Carrier::B))),
    )
    .unwrap();
    let wanted = LowRankSettings { error: 1e-3, max_rank: 20 };
    let rectangle = [[-4.0, -4.0], [24.0, 16.0]];
    let found = low_rank(&foot.offsets(), (rectangle, None), &|p| foot.tool(p), &|_| true, &wanted)
        .unwrap();
    assert!(found.report.negative().is_none(), "{:?}", found.report);
    let normal = Tif::varying(found.tool).unwrap();
    let on = OnForm::new(form, &desired).unwrap();
    let developed = on.developed(&desired).unwrap();
    let along = raster(&developed, &RasterSettings::new(1.0, 1.0, 3.0)).unwrap();
    let along = on.projected(&along).unwrap();

    // In space, about the centre of the sphere: the depth along the normal at the pixel, of the distance from the axis of
    // the tool.
    let of_centre = |x: f64, y: f64| {
        let d: [f64; 2] = [x - 10.0, y - 6.0];
        let z = -(RADIUS_MM * RADIUS_MM - d[0] * d[0] - d[1] * d[1]).sqrt();
        [d[0], d[1], z]
    };
    let in_space = |p: [f64; 2], u: [f64; 2], _: f64| {
        let (a, b) = (of_centre(p[0], p[1]), of_centre(p[0] + u[0], p[1] + u[1]));
        let cross = [0, 1, 2].map(|k| {
            let (i, j) = ((k + 1) % 3, (k + 2) % 3);
            a[i] * b[j] - a[j] * b[i]
        });
        let distance2 = cross.iter().map(|v| v * v).sum::<f64>() / (RADIUS_MM * RADIUS_MM);
        10.0 * (-0.5 * distance2).exp() * RADIUS_MM / -b[2]
    };
    let solved = |tif: &Tif, path: &ToolPath| {
        squares::solve(&desired, tif, path, None, &settings(6000)).unwrap().dwell
    };
    let (flat, known) = (solved(&tif, &path), solved(&normal, &along));
    let on_flat_part =
        left_nm(&at_uniform_feed(&path, flat.dwell_s()), &desired, 6, 3.5, |_, u, _| {
            gaussian([10.0, 6.0], u)
        });
    let motion = at_uniform_feed(&along, known.dwell_s());
    let left = left_nm(&motion, &desired, 6, 3.5, in_space);
    println!("flat part {on_flat_part:.4} nm, sphere {left:.4} nm");
    // Measured 0.419 and 0.429 nm: the tool is as wide on both, and so is what it cannot reach.
    assert!(left <= 1.1 * on_flat_part, "{left} {on_flat_part}");
}

/// A disk on a steep sphere: the corners of the grid of weights are beside the part, where the sphere is steeper still.
#[test]
fn places_beside_the_part_do_not_make_a_tool_that_adds_material() {
    let text = std::fs::read_to_string(workspace().join("fixtures/disk-100.json")).unwrap();
    let recipe: Recipe = serde_json::from_str(&text).unwrap();
    let made = make(&recipe).unwrap();
    let form = Form::sphere(-100.0, [0.0, 0.0]).unwrap();
    let places = Places::new(&made.surface).with_form(form).unwrap();
    let foot = Footprint::new(
        &made.tif,
        &places,
        Direction::Normal(Box::new(ToolFrame::of_carrier(Carrier::B))),
    )
    .unwrap();
    let wanted = LowRankSettings { error: 3e-3, max_rank: 64 };
    // As the program asks for it: half the size of the tool beyond the part.
    let beyond_mm = made.tif.grid().x.end_mm();
    let edge = |p: [f64; 2]| places.parameter(Parameter::EdgeDistance, p).unwrap();
    let counts = |p: [f64; 2]| edge(p) >= -beyond_mm;
    let far = places.radius_mm() + beyond_mm;
    let rectangle = [[-far, -far], [far, far]];
    let of = |p: [f64; 2]| foot.tool(p);
    let found = low_rank(&foot.offsets(), (rectangle, None), &of, &counts, &wanted).unwrap();
    assert!(found.report.negative().is_none(), "{:?}", found.report);
}

#[test]
fn causes_have_their_closed_forms() {
    let axis = |n: usize| Axis::new(-0.25 * (n / 2) as f64, 0.25, n).unwrap();
    let grid = Grid { x: axis(121), y: axis(121) };
    let disk = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        if grid.x.coordinate_mm(c).hypot(grid.y.coordinate_mm(r)) <= 15.0 { 0.0 } else { f64::NAN }
    });
    let surface = Surface::new(grid, disk).unwrap();
    // Incidence on a sphere: sin = r / R.
    let places = Places::new(&surface).on_sphere(30.0).unwrap();
    let angle = places.parameter(Parameter::Incidence, [9.0, 12.0]).unwrap();
    // Rounding of degrees.
    assert!((angle - 30.0).abs() < 1e-9, "{angle}");
    // The same from its sampled height, by splines: h^3 / 24 of a fourth derivative of 1e-3 at the edge is 1e-6 rad.
    let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let q = 900.0 - grid.x.coordinate_mm(c).powi(2) - grid.y.coordinate_mm(r).powi(2);
        -1e6 * q.sqrt()
    });
    let sampled = Form::sampled(&Surface::new(grid, height).unwrap()).unwrap();
    let by_samples = Places::new(&surface).with_form(sampled).unwrap();
    let angle = by_samples.parameter(Parameter::Incidence, [8.9, 11.9]).unwrap();
    let expected = (8.9_f64.hypot(11.9) / 30.0).asin().to_degrees();
    assert!((angle - expected).abs() < 1e-4, "{angle} {expected}");
    // The distance to the edge of a disk, to a pixel.
    let edge = places.parameter(Parameter::EdgeDistance, [11.0, 0.0]).unwrap();
    assert!((edge - 4.0).abs() < 0.25, "{edge}");
    let outside = places.parameter(Parameter::EdgeDistance, [0.0, 17.0]).unwrap();
    assert!((outside + 2.0).abs() < 0.25, "{outside}");

    // A pad whose centre is on a straight edge: half of it is covered. With the same force the uniform pressure is
    // twice that on the part, and the linear law is in equilibrium.
    let half = Array2::from_shape_fn(grid.shape(), |(_, c)| {
        if grid.x.coordinate_mm(c) <= 0.0 { 0.0 } else { f64::NAN }
    });
    let half = Surface::new(grid, half).unwrap();
    let edge = Places::new(&half);
    let own = Grid { x: axis(25), y: axis(25) };
    let flat = Tif::new(own, Array2::from_elem(own.shape(), 2.0)).unwrap();
    let pad = |law| Overhang::new(&flat, &edge, law, 3.0).unwrap();
    let uniform = pad(PressureLaw::Uniform);
    // The edge is half a pixel beyond the last centre.
    let at_edge = [0.125, 0.0];
    assert!((uniform.covered(at_edge) - 0.5).abs() < 0.02);
    assert!(uniform.tool(at_edge).iter().all(|r| (r / 4.0 - 1.0).abs() < 0.04));
    // A quarter of the radius beyond: moments of the covered area by the rate of the tool itself.
    let linear = pad(PressureLaw::Linear).tool([-2.0, 0.0]);
    let (mut force, mut moment, mut area) = (0.0, 0.0, 0.0);
    for ((r, c), rate) in linear.indexed_iter() {
        let u = [own.x.coordinate_mm(c), own.y.coordinate_mm(r)];
        if u[0].hypot(u[1]) <= 3.0 {
            area += 1.0;
            if u[0] - 2.0 <= 0.125 {
                force += rate / 2.0;
                moment += u[0] * rate / 2.0;
            }
        }
    }
    // Samples of 0.25 mm resolve the rim of the pad to some percent.
    assert!((force / area - 1.0).abs() < 0.03, "{force} {area}");
    assert!((moment / (3.0 * area)).abs() < 0.03, "{moment} {area}");
    // On the part nothing changes.
    let inside = pad(PressureLaw::Linear).tool([-8.0, 0.0]);
    // Rounding of products of the samples.
    assert!(inside.iter().all(|r| (r - 2.0).abs() < 1e-9));

    // A spot that turns: at four quarter turns its samples, to rounding.
    let lean = Array2::from_shape_fn(own.shape(), |(r, c)| {
        let (x, y) = (own.x.coordinate_mm(c), own.y.coordinate_mm(r));
        (1.0 + 0.3 * x) * (-(x * x + 2.0 * y * y)).exp()
    });
    let spot = Tif::new(own, lean).unwrap();
    let (offsets, of) = turned(&spot, [0.0; 2]).unwrap();
    for (k, p) in [[5.0, 0.0], [0.0, 5.0], [-5.0, 0.0], [0.0, -5.0]].into_iter().enumerate() {
        let found = of(p);
        for ((r, c), v) in found.indexed_iter() {
            let (x, y) = (offsets.x.coordinate_mm(c), offsets.y.coordinate_mm(r));
            let [a, b] = [[x, y], [y, -x], [-x, -y], [-y, x]][k];
            // Rounding of places at the samples.
            assert!((v - spot.rate_at(a, b)).abs() < 1e-12, "{k} {x} {y}");
        }
    }

    // Its kernels and weights, near the axis and far from it, where a grid of places would follow the first badly.
    let settings = LowRankSettings { error: 1e-3, max_rank: 64 };
    let found = low_rank_by_azimuth(&offsets, ([0.0; 2], 15.0), &*of, &settings).unwrap();
    assert!(found.report.negative().is_none(), "{:?}", found.report);
    let varying = Tif::varying(found.tool).unwrap();
    for (k, radius_mm) in [0.01, 0.3, 5.0, 14.0, 40.0].into_iter().enumerate() {
        let azimuth = 0.3 + 1.3 * k as f64;
        let p = [radius_mm * azimuth.cos(), radius_mm * azimuth.sin()];
        let (mut squares, mut missed) = (0.0, 0.0);
        for ((r, c), v) in of(p).indexed_iter() {
            let found = varying.rate_of_tool_at(
                Pose::along_x(p),
                [offsets.x.coordinate_mm(c), offsets.y.coordinate_mm(r)],
            );
            squares += v * v;
            missed += (found - v).powi(2);
        }
        // The error of one azimuth may be above that of the mean over all.
        assert!(f64::sqrt(missed / squares) < 2e-3, "{radius_mm}: {}", f64::sqrt(missed / squares));
    }

    // Spots: the mixture of the two around the parameter, and the last one beyond.
    let other = Tif::new(own, spot.rate_nm_per_s() * 3.0).unwrap();
    let spots = Spots::new(vec![(4.0, other), (0.0, spot.clone())]).unwrap();
    for (parameter, factor) in [(-1.0, 1.0), (1.0, 1.5), (4.0, 3.0), (9.0, 3.0)] {
        let found = spots.tool(parameter);
        Zip::from(&found).and(spot.rate_nm_per_s()).for_each(|a, b| {
            // Rounding of a sum of two rates.
            assert!((a - factor * b).abs() < 1e-12);
        });
    }
    assert_eq!(tool_at(&spot, [1.0, 2.0]), spot.rate_nm_per_s());
}
