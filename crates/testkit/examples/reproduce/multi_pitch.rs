//! Rasters of several pitches: the multi-pitch paper, JEOS-RP 2017.

use planish_surface::psd::{Detrend, PsdSettings, Window, psd};
use planish_toolpath::multi_pitch::{MultiPitchSettings, class_pitches_mm, multi_pitch};
use planish_types::{Axis as Pixels, Grid, Surface};

use ndarray::Array2;

use crate::{
    Outcome,
    claim::{Claim, significant},
    figure::{Axis, Series, chart},
    fixture,
    lines::{Spot, ripple},
    plate,
};

/// The paper's TIF is not published: a Gaussian of half the widest pitch.
const SIGMA_MM: f64 = 0.4;

pub fn reproduce() -> Outcome {
    let mut rows = ripples();
    rows.extend(spectrum());
    rows.extend(pitches());
    // Fig. 13
    let (full, mut figures) = plate::reproduce(SIGMA_MM);
    figures.push(("ripple", ripple_figure()));
    Outcome { tables: vec![("multi-pitch", rows), ("plate", full)], figures }
}

fn spot() -> Spot {
    Spot(vec![(10.0, SIGMA_MM)])
}

/// Simulated (PV over mean, pitch in mm).
const PITCHES_MM: [f64; 5] = [0.7, 0.8, 1.0, 1.2, 1.6];

fn ripples() -> Vec<Claim> {
    let spot = spot();
    let apart = PITCHES_MM
        .map(|d| (ripple(&spot.simulated(d, 1.0), d) / spot.relative_ripple(d) - 1.0).abs())
        .into_iter()
        .fold(0.0, f64::max);
    let pv_nm = |density: f64| {
        let profile = spot.simulated(0.8, density);
        let range = |(l, h): (f64, f64), p: &[f64; 2]| (l.min(p[1]), h.max(p[1]));
        let (low, high) = profile.iter().fold((f64::MAX, f64::MIN), range);
        high - low
    };
    let densities = [1.0, 2.0, 5.0];
    let linear = densities.map(|d| (pv_nm(d) / (d * pv_nm(1.0)) - 1.0).abs());
    let linear = linear.into_iter().fold(0.0, f64::max);
    let grows = PITCHES_MM.map(|d| spot.relative_ripple(d));
    let narrow = spot.relative_ripple(0.4) / spot.relative_ripple(0.8);
    vec![
        Claim::statement(
            "the ripple PVe is linear in the removal (Fig. 7)",
            "it is",
            if linear < 1e-6 { "within 1e-6".into() } else { significant(linear, 2) },
            linear < 1e-6,
        )
        .remark("up to five times the removal"),
        Claim::statement(
            "the relative ripple PVn grows with the pitch, with a knee (Fig. 7)",
            "it does",
            grows.map(|v| significant(v, 3)).join(" / "),
            grows.windows(2).all(|w| w[0] < w[1]),
        )
        .remark("sigma 0.4 mm, pitches 0.7 / 0.8 / 1.0 / 1.2 / 1.6 mm"),
        Claim::check(
            "simulated ripple against the closed form of Poisson's summation",
            if apart < 1e-4 { "within 1e-4".into() } else { significant(apart, 2) },
            apart < 1e-4,
        ),
        Claim::check(
            "half the pitch makes lines invisible (ripple at 0.4 mm over that at 0.8 mm)",
            if narrow < 1e-5 { "below 1e-5".into() } else { significant(narrow, 2) },
            narrow < 0.01,
        ),
    ]
}

/// Fig. 2: a sine of the same height has the same RMS in the band, whatever its frequency.
fn spectrum() -> Vec<Claim> {
    // 51.2 mm: frequencies of whole periods fall on the lattice of the spectrum.
    let axis = |n| Pixels::new(0.0, 0.1, n).expect("an axis");
    let grid = Grid { x: axis(512), y: axis(16) };
    let pv_nm = 20.0;
    let rms = [8.0, 32.0, 128.0].map(|periods| {
        let z = Array2::from_shape_fn(grid.shape(), |(_, c)| {
            0.5 * pv_nm * (2.0 * std::f64::consts::PI * periods * c as f64 / 512.0).sin()
        });
        let settings = PsdSettings {
            window: Window::Rectangular,
            detrend: Detrend::Mean,
            band_per_mm: vec![[0.0303, 8.33]],
        };
        let map = Surface::new(grid, z).expect("a map");
        psd(&map, &settings).expect("a spectrum").report.bands[0].rms_x_nm
    });
    let spread = rms[2] / rms[0] - 1.0;
    vec![
        Claim::statement(
            "RMS of a ripple in 0.0303 ... 8.33 / mm does not depend on its frequency (Fig. 2)",
            "it does not",
            format!("{} nm at 0.16, 0.63 and 2.5 / mm", significant(rms[0], 4)),
            spread.abs() < 1e-9,
        )
        .remark("PV 20 nm; the RMS is PV / (2 sqrt 2)"),
    ]
}

fn pitches() -> Vec<Claim> {
    // Eqs 4 and 5 with the printed bands: the depths in Eq. 9 are 0.5, 1, 2, 3 steps. The pitches
    // are compared as parts of the first, so that neither the VRR nor the feed is needed.
    let depth = [0.5, 1.0, 2.0, 3.0, 3.5];
    let pitch = class_pitches_mm(&depth, 1.0, [1e-3, 1e3]);
    let part = |k: usize| pitch[k] / pitch[0];
    let why = "Eqs 4 to 10 give 0.80, 0.40, 0.20 and 0.133 mm";
    let mut rows = vec![
        Claim::number("pitch of class 2 over class 1 (0.395 / 0.8 mm)", "", 0.494, part(1), 0.02),
        Claim::number("pitch of class 3 over class 1 (0.132 / 0.8 mm)", "", 0.165, part(2), 0.02)
            .differs(why),
        Claim::number("pitch of class 4 over class 1 (0.099 / 0.8 mm)", "", 0.124, part(3), 0.02)
            .differs("as above; 0.099 mm asks for a depth beyond the largest of the part"),
    ];

    // Eq. 9 with the middle of a band leaves its shallow half faster than the machine.
    let plate = fixture("square-200");
    let settings = MultiPitchSettings {
        classes: 4,
        max_velocity_mm_per_s: 3.0,
        min_pitch_mm: 0.1,
        max_pitch_mm: 10.0,
        min_area_mm2: None,
        step_mm: 4.0,
        overscan_mm: 7.0,
    };
    let planned = multi_pitch(&plate.surface, &plate.tif, &settings).expect("a path").report;
    let inside = planned.classes.iter().skip(1);
    let (too_fast, area) =
        inside.fold((0.0, 0.0), |(t, a), c| (t + c.too_fast_mm2, a + c.area_mm2));
    let z = plate.surface.height_nm();
    let (low, high) = z.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    let step = (high - low) / 3.5;
    let shallow = [1.0, 2.0, 3.0].map(|k| {
        let of = |from: f64, to: f64| {
            z.iter().filter(|v| (from * step..to * step).contains(&(**v - low))).count() as f64
        };
        of(k - 0.5, k) / of(k - 0.5, (k + 0.5).min(3.5))
    });
    rows.push(
        Claim::statement(
            "Eq. 9 keeps the feed below the largest one (part of classes 2, 3, 4 that is faster)",
            "everywhere",
            shallow.map(|p| format!("{:.0} %", 100.0 * p)).join(" / "),
            shallow.iter().all(|p| *p == 0.0),
        )
        .differs("r_k is the middle of a band, not its least depth"),
    );
    rows.push(
        Claim::check(
            "the same with the least depth of the band in Eq. 9 (part of the area that is faster)",
            format!("{} %", significant(100.0 * too_fast / area, 2)),
            too_fast / area < 0.1,
        )
        .remark("what is left are small regions that joined a neighbour"),
    );
    rows
}

fn ripple_figure() -> String {
    let spot = spot();
    let at = |i: i32| 0.5 + 0.02 * f64::from(i);
    let formula = (0..=60).map(|i| [at(i), spot.relative_ripple(at(i))]).collect();
    let simulated = PITCHES_MM.map(|d| [d, ripple(&spot.simulated(d, 1.0), d)]).to_vec();
    chart(
        &Axis {
            label: "pitch, mm",
            ticks: vec![0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8],
            log: false,
        },
        &Axis {
            label: "ripple, PV over mean",
            ticks: vec![1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0],
            log: true,
        },
        &[
            Series { name: "Poisson's summation, sigma 0.4 mm", points: formula, dots: false },
            Series { name: "simulated", points: simulated, dots: true },
        ],
    )
}
