//! Feed as a B-spline: the B-spline deconvolution paper for fluid jets.

use std::f64::consts::PI;

use planish_bspline_feed::{Plan, Settings, deconvolution::Refinement, plan, plan::Method};
use planish_fixture::make;
use planish_simulate::simulate;
use planish_testkit::machine;
use planish_toolpath::{LineOrder, RasterSettings, Scan, Turn, raster};
use planish_types::Surface;
use planish_verify::{VerifySettings, verify};

use crate::{
    Outcome,
    claim::{Claim, significant},
    figure::{Axis, Series, chart},
    recipe,
};

/// Cylinders meet here, mm; away from the ends of the part.
const CUSPS_MM: [f64; 5] = [5.0, 8.0, 10.0, 13.0, 15.0];

pub fn reproduce() -> Outcome {
    // A strip of the fixture: the cylinders do not change along y.
    let mut strip = recipe("multi-cylinder");
    strip.pixels[1] = 41;
    let part = make(&strip).expect("a fixture");
    let (surface, tif) = (&part.surface, &part.tif);
    let limits = machine([20.0, 20.0], [200.0, 200.0]);
    let path = raster(
        surface,
        &RasterSettings {
            pitch_mm: 0.2,
            step_mm: 0.2,
            overscan_mm: tif.half_size_mm()[0],
            scan: Scan::X,
            turn: Turn::Square,
            line_origin_mm: None,
            order: LineOrder::Sequential,
            one_directional: false,
            pitch_range_mm: None,
        },
    )
    .expect("a raster");
    let base = Settings { tolerance: 1e-2, max_sweeps: 40, ..Settings::default() };
    let with = |settings: Settings| plan(surface, tif, &path, &limits, &settings).expect("a feed");
    let spline = with(base);
    let vrr = with(Settings { method: Method::Vrr, ..base });
    let removed = with(Settings { refinement: Refinement::KnotRemoval, ..base });
    let within = [&spline, &vrr, &removed].iter().all(|p| {
        let verdict = verify(&p.trajectory, &limits, &VerifySettings::default());
        verdict.expect("a verdict").limits_respected
    });
    let executed = |p: &Plan| {
        let done = simulate(&p.trajectory, tif, surface, planish_simulate::Settings::Gridded);
        done.expect("a removal").removal
    };
    let done = [&vrr, &spline, &removed].map(executed);
    let rms = done.each_ref().map(|r| r.residual().statistics().rms);
    let profiles = done.each_ref().map(|r| middle_row(r.removal_nm()));
    let desired = middle_row(surface.height_nm());
    let step = surface.grid().x.step_mm();
    let left_nm = profiles.each_ref().map(|p| {
        let at = |x: f64| (x / step).round() as usize;
        CUSPS_MM.map(|x| (p[at(x)] - desired[at(x)]).abs()).iter().sum::<f64>()
            / CUSPS_MM.len() as f64
    });
    let kept = [0, 1].map(|k| amplitude(&profiles[k], step) / amplitude(&desired, step));
    let pixels = surface.grid().shape().1;
    let per_line = spline.report.control_values as f64 / spline.report.passes as f64;
    let rows = vec![
        Claim::statement(
            "valleys are sharper than with Eq. 1 (excess removal at the cusps, VRR against B-spline)",
            "they are (Fig. 3)",
            format!("{} against {} nm", significant(left_nm[0], 3), significant(left_nm[1], 3)),
            left_nm[1] < 0.6 * left_nm[0],
        )
        .remark("the jet is 0.52 mm wide, the cusps are sharp"),
        Claim::statement(
            "the spectrum of the valleys is kept (amplitude at 1 / mm over the desired one)",
            "it is (Fig. 3)",
            format!("{} against {}", significant(kept[0], 3), significant(kept[1], 3)),
            kept[1] > 2.0 * kept[0],
        ),
        Claim::check(
            "residual of the VRR feed over that of the B-spline",
            significant(rms[0] / rms[1], 3),
            rms[0] / rms[1] > 2.0,
        )
        .remark("both executed within 20 mm/s and 200 mm/s^2"),
        Claim::statement(
            "knot refinement keeps the largest acceleration (Fig. 2)",
            "it does",
            format!("{} of the limit", significant(removed.report.acceleration_use, 3)),
            within && removed.report.acceleration_use <= 1.0 + 1e-6,
        ),
        Claim::check(
            "what it costs (RMS with knot removal, and with the convex-concave procedure)",
            format!("{} and {} nm", significant(rms[2], 3), significant(rms[1], 3)),
            rms[1] < rms[2],
        )
        .remark("on coupled lines its sweeps do not converge; the procedure keeps all knots"),
        Claim::statement(
            "fewer unknowns than pixels (per line)",
            "far fewer",
            format!("{per_line:.0} against {pixels}"),
            per_line < 0.5 * pixels as f64,
        ),
    ];
    Outcome {
        tables: vec![("bspline", rows)],
        figures: vec![("valleys", figure(surface, &desired, &profiles))],
    }
}

fn middle_row(map: &ndarray::Array2<f64>) -> Vec<f64> {
    map.row(map.nrows() / 2).to_vec()
}

/// Amplitude at 1 / mm under a Hann window, nm.
fn amplitude(z: &[f64], step_mm: f64) -> f64 {
    let n = z.len() as f64;
    let mean = z.iter().sum::<f64>() / n;
    let (mut re, mut im) = (0.0, 0.0);
    for (k, v) in z.iter().enumerate() {
        let window = 1.0 - (2.0 * PI * k as f64 / n).cos();
        let (s, c) = (2.0 * PI * k as f64 * step_mm).sin_cos();
        re += window * (v - mean) * c;
        im += window * (v - mean) * s;
    }
    2.0 * re.hypot(im) / n
}

fn figure(surface: &Surface, desired: &[f64], profiles: &[Vec<f64>; 3]) -> String {
    let x = surface.grid().x;
    let curve = |name, z: &[f64]| {
        let inside = |(c, v): (usize, &f64)| {
            let at = x.at(c);
            (4.0..=11.0).contains(&at).then_some([at, *v])
        };
        Series { name, points: z.iter().enumerate().filter_map(inside).collect(), dots: false }
    };
    chart(
        &Axis { label: "x, mm", ticks: vec![4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0], log: false },
        &Axis {
            label: "removal, nm",
            ticks: vec![0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0],
            log: false,
        },
        &[curve("desired", desired), curve("VRR", &profiles[0]), curve("B-spline", &profiles[1])],
    )
}
