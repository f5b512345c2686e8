//! Time of planning with all axes of a machine over that for x and y alone: an asphere, a spiral of 10 000 points.
//!
//! `cargo run --release -p planish-joint --example further_axes`

use std::{f64::consts::TAU, path::Path, time::Instant};

use ndarray::Array2;
use planish_form::{Form, FormFile, FormKind};
use planish_joint::{FurtherAxes, MachineAxes, Price, Settings, plan, plan_with_further_axes};
use planish_types::{Axis, Grid, Machine, MachineFile, Surface, Tif, ToolPath, plausible::Rms};

/// Half the side of the part, mm. Larger: longer paths. Smaller: shorter ones.
const HALF_MM: f64 = 20.0;

/// Number of points of the path. Larger: more time. Smaller: the fixed part of the time counts.
const POINTS: usize = 10_000;

/// Number of times that each plan is made; the least time counts. Larger: less noise. Smaller: less time.
const RUNS: usize = 2;

/// Convex, with a slope of some 25 degrees at the end of the path.
fn asphere() -> Form {
    let file = FormFile {
        kind: FormKind::Asphere,
        radius_mm: Some(-70.0),
        conic_constant: Some(-0.6),
        even_terms: Some(vec![2e-8]),
        ..FormFile::plane()
    };
    Form::new(&file, None).expect("a form")
}

fn machine() -> Machine {
    let file = "../../fixtures/machines/bonnet-five-axis.json";
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(file));
    let file: MachineFile = serde_json::from_str(&text.expect("a file")).expect("a machine file");
    Machine::new(file).expect("a machine")
}

fn tif() -> Tif {
    let a = Axis::new(-5.0, 0.5, 21).expect("an axis");
    let grid = Grid { x: a, y: a };
    let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        60.0 * (-(a.at(c).powi(2) + a.at(r).powi(2)) / 4.5).exp()
    });
    Tif::new(grid, rate).expect("a tool")
}

fn desired() -> Surface {
    let n = (4.0 * HALF_MM) as usize + 1;
    let a = Axis::new(-HALF_MM, 0.5, n).expect("an axis");
    let grid = Grid { x: a, y: a };
    let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (x, y) = (a.at(c), a.at(r));
        60.0 + 30.0 * (-(x * x + 2.0 * y * y) / 80.0).exp() + 8.0 * (0.4 * x + 0.25 * y).sin()
    });
    Surface::new(grid, height).expect("a map")
}

/// A spiral from half a pitch to the corners of the part.
fn spiral() -> ToolPath {
    let pitch_mm = 1.0;
    let area = std::f64::consts::PI * (1.5 * HALF_MM).powi(2);
    let apart_mm = area / pitch_mm / POINTS as f64;
    let mut points = Vec::new();
    let mut angle = 0.0f64;
    loop {
        let r = 0.5 * pitch_mm + pitch_mm * angle / TAU;
        if r > 1.5 * HALF_MM {
            let n = points.len() - 1;
            return ToolPath::through(points, vec![true; n], vec![0; n]).expect("a path");
        }
        points.push([r * angle.cos(), r * angle.sin()]);
        angle += (apart_mm / r).min(0.5);
    }
}

/// Makes a plan, prints its row and returns the least time of planning, s.
fn row(name: &str, path: &ToolPath, machine: &Machine, axes: Option<&dyn FurtherAxes>) -> f64 {
    let (desired, tif, limits) = (desired(), tif(), machine.limits_on_part());
    let settings = Settings { price: Price::Nm2PerS(2e-3), ..Settings::default() };
    let mut least_s = f64::INFINITY;
    let mut last = None;
    for _ in 0..RUNS {
        let start = Instant::now();
        let plan = match axes {
            None => plan(&desired, &tif, path, &limits, &settings),
            Some(axes) => plan_with_further_axes(&desired, &tif, path, (&limits, axes), &settings),
        };
        least_s = least_s.min(start.elapsed().as_secs_f64());
        last = Some(plan.expect("a plan"));
    }
    let Some(plan) = last else { return least_s };
    let r = &plan.report;
    println!(
        "| {name} | {} | {} | {:.2} | {:.3} | {} | {} | {} | {least_s:.2} |",
        path.len() + 1,
        r.nodes,
        plan.trajectory.total_time_s(),
        Rms::of(plan.removal.residual()).rms_nm,
        r.end,
        r.rounds,
        plan.refused.as_deref().unwrap_or("yes"),
    );
    least_s
}

fn main() {
    let (path, machine) = (spiral(), machine());
    let axes = MachineAxes::new(&machine, &asphere()).expect("axes").expect("more axes");
    println!(
        "| axes | points | nodes | time, s | residual, nm | end | rounds | limits kept | planning, s |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    let flat = row("contact x, y", &path, &machine, None);
    let all = row("x, y, z, a, b", &path, &machine, Some(&axes));
    println!("planning with five axes over the flat plan: {:.2}", all / flat);
}
