//! Rasters of several pitches: the multi-pitch paper, JEOS-RP 2017.

use planish_surface::psd::{Detrend, PsdSettings, Window, psd};
use planish_toolpath::multi_pitch::{Links, MultiPitchSettings, class_pitches_mm, multi_pitch};
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

/// Standard deviation of the Gaussian TIF, mm. The TIF of the paper is not published. Larger: less ripple
/// at a pitch. Smaller: more. Chosen: half of the widest pitch.
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

/// Pitches at which the ripple is simulated, mm.
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
    let knee = knee(&spot);
    let narrow = spot.relative_ripple(0.4) / spot.relative_ripple(0.8);
    vec![
        Claim::statement(
            "the ripple PVe is linear in the removal (Fig. 7)",
            "it is",
            if linear < 1e-6 { "within 1e-6".into() } else { significant(linear, 2) },
            linear < 1e-6,
        )
        .by_arithmetic("up to five times the removal; the removal is linear in the dwell time"),
        Claim::statement(
            "the relative ripple PVn grows with the pitch (Fig. 7)",
            "it does",
            grows.map(|v| significant(v, 3)).join(" / "),
            grows.windows(2).all(|w| w[0] < w[1]),
        )
        .remark("sigma 0.4 mm, pitches 0.7 / 0.8 / 1.0 / 1.2 / 1.6 mm"),
        Claim::statement(
            "it has a knee (where PVn bends most; mean slopes from 0.4 mm to it and from it to 1.6 mm)",
            "it has (Fig. 7)",
            format!(
                "at {} mm; {} and {} /mm",
                significant(knee.at_mm, 2),
                significant(knee.slopes_per_mm[0], 2),
                significant(knee.slopes_per_mm[1], 2)
            ),
            knee.is_inside && knee.slopes_per_mm[1] > 5.0 * knee.slopes_per_mm[0],
        )
        .remark("more than five times as steep beyond it"),
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

/// Pitch at which the ripple bends most as a function of the pitch, and its slopes on both sides.
struct Knee {
    at_mm: f64,
    /// True if the curve bends less at both ends of the range.
    is_inside: bool,
    slopes_per_mm: [f64; 2],
}

/// Finds the knee by second differences of the closed form, for pitches from one sigma to four.
fn knee(spot: &Spot) -> Knee {
    let (step, first, last) = (0.01, 1.0 * SIGMA_MM, 4.0 * SIGMA_MM);
    let bend = |d: f64| {
        spot.relative_ripple(d + step) - 2.0 * spot.relative_ripple(d)
            + spot.relative_ripple(d - step)
    };
    let places: Vec<f64> =
        (0..).map(|k| first + step * f64::from(k)).take_while(|d| *d <= last).collect();
    let at_mm = places.iter().copied().max_by(|a, b| bend(*a).total_cmp(&bend(*b)));
    let at_mm = at_mm.expect("the range is not empty");
    let slope =
        |from: f64, to: f64| (spot.relative_ripple(to) - spot.relative_ripple(from)) / (to - from);
    let is_inside = [first, last].iter().all(|end| bend(*end) < 0.5 * bend(at_mm));
    Knee { at_mm, is_inside, slopes_per_mm: [slope(first, at_mm), slope(at_mm, last)] }
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
        .by_arithmetic("PV 20 nm; the RMS of a sine is PV / (2 sqrt 2)"),
    ]
}

fn pitches() -> Vec<Claim> {
    // Eqs 4 and 5 with the printed bands: the depths in Eq. 9 are 0.5, 1, 2, 3 steps. The pitches
    // are compared as parts of the first, so that neither the VRR nor the feed is needed.
    // A fifth class, of 4 steps, is one that the part has not.
    let depth = [0.5, 1.0, 2.0, 3.0, 4.0, 4.5];
    let pitch = class_pitches_mm(&depth, 1.0, [1e-3, 1e3]);
    let part = |k: usize, of: usize| pitch[k - 1] / pitch[of - 1];
    let formula = "0.395 mm / (k - 1), which Eqs 9 and 10 are from the second class on";
    let mut rows = vec![
        Claim::arithmetic(
            "pitch of class 2 over class 1 (0.395 / 0.8 mm)",
            "",
            0.494,
            part(2, 1),
            0.02,
            "the ratio of the depths in Eq. 9, half a step over a step",
        ),
        Claim::number(
            "pitch of class 3 over class 2 (0.132 / 0.395 mm)",
            "",
            0.334,
            part(3, 2),
            0.02,
        )
        .differs(
            "k = 3 was left out: 0.395 mm / (k - 1) is 0.198 mm there, and 0.132 mm for k = 4",
        ),
        Claim::number(
            "pitch of class 4 over class 2 (0.099 / 0.395 mm)",
            "",
            0.251,
            part(4, 2),
            0.02,
        )
        .differs("as above: 0.099 mm is that of k = 5, a depth that the part has not"),
        Claim::arithmetic(
            "pitch of k = 4 over k = 2, against 0.132 / 0.395 mm",
            "",
            0.334,
            part(4, 2),
            5e-3,
            formula,
        ),
        Claim::arithmetic(
            "pitch of k = 5 over k = 2, against 0.099 / 0.395 mm",
            "",
            0.251,
            part(5, 2),
            5e-3,
            formula,
        ),
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
        links: Links::Off,
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
