//! Feed as a B-spline: the B-spline deconvolution paper for fluid jets.

use std::f64::consts::PI;

use ndarray::{Array1, Array2};
use planish_bspline_feed::{
    FeedPlan, FeedSettings,
    deconvolution::Refinement,
    limited::{FeedLimits, Quadratic, convex_concave_step, highest_peak, knot_removal},
    plan,
    plan::FeedSource,
};
use planish_fixture::make;
use planish_numerics::{bspline::Knots, quadrature::gauss_legendre};
use planish_simulate::simulate;
use planish_testkit::machine;
use planish_toolpath::{RasterSettings, raster};
use planish_types::{DwellDensity, Surface, Tif};
use planish_verify::{VerifySettings, verify};

use crate::{
    Outcome,
    claim::{Claim, significant},
    figure::{Axis, Series, chart, stacked},
    recipe,
};

/// Smallest ratio of the largest acceleration to its limit, for a feed without a limit, at which the claim
/// holds. The feed steps in the cusp, so that the exact value depends on rounding; it was 2786 on one
/// machine. Larger: the claim may fail on another machine. Smaller: a weaker claim.
const UNLIMITED: f64 = 100.0;

/// Places where cylinders meet, mm; those away from the ends of the part.
const CUSPS_MM: [f64; 5] = [5.0, 8.0, 10.0, 13.0, 15.0];

pub fn reproduce() -> Outcome {
    // A strip of the fixture: the cylinders do not change along y.
    let mut strip = recipe("multi-cylinder");
    strip.pixels[1] = 41;
    let part = make(&strip).expect("a fixture");
    let (surface, tif) = (&part.surface, &part.tif);
    let limits = machine([20.0, 20.0], [200.0, 200.0]);
    let path =
        raster(surface, &RasterSettings::new(0.2, 0.2, tif.half_size_mm()[0])).expect("a raster");
    let base = FeedSettings { relative_gap: 1e-2, ..FeedSettings::default() };
    let with =
        |settings: FeedSettings| plan(surface, tif, &path, &limits, &settings).expect("a feed");
    let spline = with(base);
    let vrr = with(FeedSettings { method: FeedSource::Vrr, ..base });
    let removed = with(FeedSettings { refinement: Refinement::KnotRemoval, ..base });
    let within = [&spline, &vrr, &removed].iter().all(|p| {
        let verdict = verify(&p.trajectory, &limits, &VerifySettings::default());
        verdict.expect("a verdict").limits_respected
    });
    let executed = |p: &FeedPlan| {
        let done =
            simulate(&p.trajectory, tif, surface, planish_simulate::SimulationSettings::Gridded);
        done.expect("a removal").removal
    };
    let done = [&vrr, &spline, &removed].map(executed);
    let rms = done.each_ref().map(|r| r.residual().statistics().rms);
    let profiles = done.each_ref().map(|r| middle_row(r.removal_nm()));
    let desired = middle_row(surface.height_nm());
    let step = surface.grid().x.step_mm();
    let left_nm = profiles.each_ref().map(|p| {
        let at = |x: f64| (x / step).round() as usize;
        CUSPS_MM.map(|x| desired[at(x)] - p[at(x)]).iter().sum::<f64>() / CUSPS_MM.len() as f64
    });
    let kept = [0, 1].map(|k| amplitude(&profiles[k], step, 1.0) / amplitude(&desired, step, 1.0));
    let least = [&vrr, &spline].map(|p| least_feed_mm_per_s(&p.density));
    let pixels = surface.grid().shape().1;
    let per_line = spline.report.control_values as f64 / spline.report.passes as f64;
    let rows = vec![
        Claim::statement(
            "valleys are sharper than with Eq. 1 (removal that is missing at the cusps, VRR against B-spline)",
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
            "least feed along the lines (the paper bounds the feed from above only; VRR and B-spline)",
            format!("{} and {} mm/s", significant(least[0], 3), significant(least[1], 3)),
            least[1] > 0.0 && least[1] < least[0],
        )
        .remark("the deconvolution stays longer in the valleys; a machine that stalls below a feed would need the bound"),
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
        .remark(format!("its sweeps ended as `{}`; the procedure keeps all knots", removed.report.end)),
        Claim::statement(
            "fewer unknowns than pixels (per line)",
            "far fewer",
            format!("{per_line:.0} against {pixels}"),
            per_line < 0.5 * pixels as f64,
        ),
    ];
    let (mut rows, line) = (rows, Line::new(&desired, step, tif, 0.2));
    let feeds = line.solve();
    rows.extend(line.rows(&feeds));
    Outcome {
        tables: vec![("bspline", rows)],
        figures: vec![
            ("valleys", figure(surface, &desired, &profiles)),
            ("spectrum", spectrum(&desired, &profiles, step)),
            ("knots", line.figure(&feeds)),
        ],
    }
}

/// Smallest feed, mm/s: the inverse of the largest density of the splines, from their values at Greville's
/// abscissae.
fn least_feed_mm_per_s(density: &DwellDensity) -> f64 {
    1.0 / density.dwell_density_s_per_mm().iter().copied().fold(0.0, f64::max)
}

fn middle_row(map: &Array2<f64>) -> Vec<f64> {
    map.row(map.nrows() / 2).to_vec()
}

/// Amplitude at a frequency under a Hann window, nm.
fn amplitude(z: &[f64], step_mm: f64, per_mm: f64) -> f64 {
    let n = z.len() as f64;
    let mean = z.iter().sum::<f64>() / n;
    let (mut re, mut im) = (0.0, 0.0);
    for (k, v) in z.iter().enumerate() {
        let window = 1.0 - (2.0 * PI * k as f64 / n).cos();
        let (s, c) = (2.0 * PI * per_mm * k as f64 * step_mm).sin_cos();
        re += window * (v - mean) * c;
        im += window * (v - mean) * s;
    }
    2.0 * re.hypot(im) / n
}

/// One line that stands for all lines, as in the source. Together the lines remove `z(x) = integral of
/// H(x-X) D(X) dX`, H(x) = VRR / pitch times the Gaussian of the jet.
struct Line<'a> {
    desired_nm: &'a [f64],
    step_mm: f64,
    knots: Knots,
    /// G (pixels, control values), nm mm/s.
    basis: Array2<f64>,
    /// Removal by the density z p / VRR of Eq. 1, nm.
    vrr_nm: Vec<f64>,
}

/// Control values on the knots of the line.
struct Feeds {
    /// Control values without the limit on acceleration, s/mm.
    free: Vec<f64>,
    /// Control values after knot removal, s/mm; `kept` has the remaining knots.
    removed: Vec<f64>,
    kept: Knots,
    /// Control values by the convex-concave procedure, s/mm.
    procedure: Vec<f64>,
}

/// Limits of the machine of the fixture: largest feed 20 mm/s, acceleration 200 mm/s^2.
const MACHINE: FeedLimits =
    FeedLimits { min_density_s_per_mm: 1.0 / 20.0, max_acceleration_mm_per_s2: 200.0 };

/// Range of x away from the ends of the part, mm, for residuals without the ends.
const INNER_MM: [f64; 2] = [6.5, 15.5];

/// Overscan of the line, mm: the reach of the jet.
const BEYOND_MM: f64 = 0.9;

impl<'a> Line<'a> {
    fn new(desired_nm: &'a [f64], step_mm: f64, tif: &Tif, pitch_mm: f64) -> Self {
        let vrr = tif.vrr_nm_mm2_per_s();
        // A Gaussian has VRR = 2 pi sigma^2 peak.
        let sigma = (vrr / (2.0 * PI * tif.peak_nm_per_s())).sqrt();
        let kernel = |x: f64| {
            vrr / pitch_mm * (-0.5 * (x / sigma).powi(2)).exp() / (sigma * (2.0 * PI).sqrt())
        };
        let (n, length) = (desired_nm.len(), (desired_nm.len() - 1) as f64 * step_mm);
        // A quarter of the width of the jet apart.
        let spacing = 0.25 * (8.0 * 2.0_f64.ln()).sqrt() * sigma;
        let knots = Knots::uniform(
            length + 2.0 * BEYOND_MM,
            ((length + 2.0 * BEYOND_MM) / spacing).ceil() as usize,
        );
        let mut basis = Array2::zeros((n, knots.len()));
        let mut vrr_nm = vec![0.0; n];
        for span in knots.breaks().windows(2) {
            for (x, weight) in gauss_legendre::<6>() {
                let s = span[0] + (span[1] - span[0]) * x;
                let (first, b) = knots.basis(s);
                let near = ((s - BEYOND_MM) / step_mm).round().clamp(0.0, (n - 1) as f64) as usize;
                let density = (desired_nm[near] * pitch_mm / vrr).max(MACHINE.min_density_s_per_mm);
                for r in 0..n {
                    let g =
                        (span[1] - span[0]) * weight * kernel(r as f64 * step_mm - (s - BEYOND_MM));
                    vrr_nm[r] += g * density;
                    for (j, b) in b.iter().enumerate() {
                        basis[[r, first + j]] += g * b;
                    }
                }
            }
        }
        Self { desired_nm, step_mm, knots, basis, vrr_nm }
    }

    fn solve(&self) -> Feeds {
        let mut p = self.basis.t().dot(&self.basis);
        let strongest = p.diag().iter().copied().fold(0.0, f64::max);
        let z = Array1::from(self.desired_nm.to_vec());
        let mut q = self.basis.t().dot(&z).to_vec();
        for (i, q) in q.iter_mut().enumerate() {
            // A pull to the least density makes the problem definite.
            p[[i, i]] += 1e-5 * strongest;
            *q += 1e-5 * strongest * MACHINE.min_density_s_per_mm;
        }
        for i in 1..self.knots.len() - 1 {
            // Second differences, as weak as in planish-bspline-feed.
            for (a, va) in [(i - 1, 1.0), (i, -2.0), (i + 1, 1.0)] {
                for (b, vb) in [(i - 1, 1.0), (i, -2.0), (i + 1, 1.0)] {
                    p[[a, b]] += 1e-4 * strongest * va * vb;
                }
            }
        }
        let objective = Quadratic { p, q };
        let free = FeedLimits { max_acceleration_mm_per_s2: 1e12, ..MACHINE };
        let by_knots = |limits| {
            let found = knot_removal(&objective, &self.knots, limits).expect("a solution");
            found.expect("knots are left")
        };
        let (free, _) = by_knots(free);
        let (removed, kept) = by_knots(MACHINE);
        let mut procedure = vec![free.iter().copied().fold(0.0, f64::max); self.knots.len()];
        let mut rows = Vec::new();
        for _ in 0..20 {
            let step = convex_concave_step(&objective, &self.knots, MACHINE, &procedure, &mut rows);
            procedure = step.expect("a solution");
        }
        Feeds { free, removed, kept, procedure }
    }

    /// RMS of the residual, over the line and between [`INNER_MM`].
    fn rms_nm(&self, d: &[f64]) -> [f64; 2] {
        let removal = self.basis.dot(&Array1::from(d.to_vec())).to_vec();
        let [from, to] = INNER_MM.map(|x| (x / self.step_mm).round() as usize);
        [rms(self.desired_nm, &removal), rms(&self.desired_nm[from..=to], &removal[from..=to])]
    }

    fn largest(&self, d: &[f64]) -> f64 {
        highest_peak(&self.knots, d).acceleration_mm_per_s2
    }

    fn rows(&self, feeds: &Feeds) -> Vec<Claim> {
        let limit = MACHINE.max_acceleration_mm_per_s2;
        let peaks = [&feeds.free, &feeds.removed].map(|d| self.largest(d));
        let left = [&feeds.free, &feeds.removed, &feeds.procedure].map(|d| self.rms_nm(d));
        let of = |k: usize| left.map(|l| significant(l[k], 3)).join(" / ");
        let vrr = rms(self.desired_nm, &self.vrr_nm);
        let knots = [&self.knots, &feeds.kept].map(|k| k.breaks().len());
        vec![
            Claim::statement(
                "one line, acceleration unlimited: residual of Eq. 1 over that of the deconvolution (RMS)",
                "sharper valleys (Fig. 3)",
                format!(
                    "{} / {} nm = {}",
                    significant(vrr, 3),
                    significant(left[0][0], 3),
                    significant(vrr / left[0][0], 2)
                ),
                vrr / left[0][0] > 2.0,
            ),
            Claim::statement(
                "one line: knot refinement brings the acceleration within the limit (largest before and after)",
                "it does (Fig. 2)",
                format!(
                    "beyond {:.0} times the limit; {:.0} mm/s^2, limit {limit:.0}",
                    UNLIMITED, peaks[1]
                ),
                peaks[0] > UNLIMITED * limit && peaks[1] <= limit,
            )
            .remark("without a limit the feed steps in the cusp, where its largest acceleration is that of rounding"),
            Claim::check(
                "one line: what that costs (knots; RMS before, after, and by the convex-concave procedure with all knots)",
                format!("{} to {} knots; {} nm", knots[0], knots[1], of(0)),
                left[0][0] < left[2][0] && left[2][0] < left[1][0],
            ),
            Claim::check(
                "the same away from the ends, 6.5 to 15.5 mm",
                format!("{} nm", of(1)),
                left[2][1] < left[1][1] && left[1][1] < 2.0 * left[2][1],
            ),
        ]
    }

    /// Fig. 2: feed, acceleration and knots before and after.
    fn figure(&self, feeds: &Feeds) -> String {
        let range = 6.5..=9.5;
        let at = |s: f64| s - BEYOND_MM;
        let curve = |name, d: &[f64], of: &dyn Fn(f64, f64) -> f64| {
            let length = self.knots.breaks()[self.knots.breaks().len() - 1];
            let points = (0..=4000).map(|k| length * f64::from(k) / 4000.0);
            let points = points
                .filter(|s| range.contains(&at(*s)))
                .map(|s| [at(s), of(self.knots.value(d, s), self.knots.derivative(d, s))]);
            Series { name, points: points.collect(), dots: false }
        };
        let feed = |density: f64, _: f64| 1.0 / density;
        // a = -D' / D^3
        let acceleration = |density: f64, slope: f64| (slope / density.powi(3)).abs();
        let limit = MACHINE.max_acceleration_mm_per_s2;
        let level = Series { name: "limit", points: vec![[6.5, limit], [9.5, limit]], dots: false };
        let dots = |name, knots: &Knots, height: f64| Series {
            name,
            points: knots
                .breaks()
                .iter()
                .map(|s| at(*s))
                .filter(|x| range.contains(x))
                .map(|x| [x, height])
                .collect(),
            dots: true,
        };
        let x = Axis {
            label: "x, mm",
            ticks: (0..=6).map(|k| 6.5 + 0.5 * f64::from(k)).collect(),
            log: false,
        };
        let powers = |low: i32, high: i32| (low..=high).map(|k| 10_f64.powi(k)).collect();
        let feed_axis = Axis { label: "feed, mm/s", ticks: powers(-2, 3), log: true };
        let acceleration_axis =
            Axis { label: "|acceleration|, mm/s^2", ticks: powers(-4, 5), log: true };
        let feeds_panel = vec![
            dots("knots before", &self.knots, 0.014),
            curve("before", &feeds.free, &feed),
            curve("after", &feeds.removed, &feed),
            dots("knots after", &feeds.kept, 0.02),
        ];
        let accelerations = vec![
            level,
            curve("before", &feeds.free, &acceleration),
            curve("after", &feeds.removed, &acceleration),
        ];
        stacked(260.0, &[(&x, &feed_axis, feeds_panel), (&x, &acceleration_axis, accelerations)])
    }
}

fn rms(a: &[f64], b: &[f64]) -> f64 {
    let off: Vec<f64> = a.iter().zip(b).map(|(a, b)| a - b).collect();
    let mean = off.iter().sum::<f64>() / off.len() as f64;
    (off.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / off.len() as f64).sqrt()
}

/// Fig. 3: amplitudes of the desired and of the executed removals, at the harmonics of the cylinders,
/// which repeat every 5 mm.
fn spectrum(desired: &[f64], profiles: &[Vec<f64>; 3], step_mm: f64) -> String {
    let curve = |name, z: &[f64]| {
        let points = (1..=15).map(|k| 0.2 * f64::from(k));
        let points = points.map(|f| [f, amplitude(z, step_mm, f)]).collect();
        Series { name, points, dots: false }
    };
    chart(
        &Axis {
            label: "spatial frequency (harmonics of 5 mm), 1/mm",
            ticks: (0..=6).map(|k| 0.5 * f64::from(k)).collect(),
            log: false,
        },
        &Axis {
            label: "amplitude, nm",
            ticks: (-3..=3).map(|k| 10_f64.powi(k)).collect(),
            log: true,
        },
        &[curve("desired", desired), curve("VRR", &profiles[0]), curve("B-spline", &profiles[1])],
    )
}

fn figure(surface: &Surface, desired: &[f64], profiles: &[Vec<f64>; 3]) -> String {
    let x = surface.grid().x;
    let curve = |name, z: &[f64]| {
        let inside = |(c, v): (usize, &f64)| {
            let at = x.coordinate_mm(c);
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
