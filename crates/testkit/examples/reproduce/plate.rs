//! The plate of the multi-pitch paper (Fig. 13): rasters of one and of several pitches at the feed of
//! Eq. 12, executed and predicted.

use ndarray::{Array2, s};
use planish_dwell::{baselines::feed_law, bounded_least_squares::Bound};
use planish_fixture::{Recipe, Shape, TifRecipe, make};
use planish_schedule::baselines::average_velocity;
use planish_simulate::{SimulationSettings as Settings, simulate};
use planish_surface::psd::{Detrend, Psd, PsdSettings, Window, psd};
use planish_testkit::ion_beam;
use planish_toolpath::{
    RasterSettings,
    multi_pitch::{Links, MultiPitchSettings, multi_pitch},
    raster,
};
use planish_types::{Surface, Tif, ToolPath};

use crate::{
    claim::{Claim, significant},
    figure::{Axis, Series, chart, maps},
    lines::Spot,
    recipe,
};

/// Widest pitch of the multi-pitch raster, and pitch of the uniform one, mm.
const WIDEST_MM: f64 = 0.8;
/// Number of classes of depth.
const CLASSES: usize = 4;
/// Pixel of the plate and of the TIF, mm; [`PERIOD`] of them make the widest pitch. Larger: the lines are
/// not resolved. Smaller: more time and memory.
const PIXEL_MM: f64 = 0.1;
/// Number of pixels per widest pitch, `WIDEST_MM / PIXEL_MM`.
const PERIOD: usize = 8;
/// Distance from borders of regions and of the plate within which ripple is not measured, mm. Larger: less
/// area. Smaller: the ripple includes edges. Chosen: 10 sigma.
const RIM_MM: f64 = 4.0;
/// y of the section of the figure, mm; it crosses all four classes of depth.
const SECTION_MM: f64 = 120.0;
/// Wavelength of a helium-neon laser, nm: the unit of heights in the paper.
const WAVE_NM: f64 = 632.8;

/// Result of a run along a path.
struct Run {
    residual: Surface,
    ripple_nm: Array2<f64>,
    time_s: f64,
    length_mm: f64,
}

impl Run {
    fn pv_um(&self) -> f64 {
        1e-3 * pv(self.residual.height_nm())
    }
}

fn pv(z: &Array2<f64>) -> f64 {
    let (low, high) = z.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    high - low
}

/// Rows, and the figures by name.
pub fn reproduce(sigma_mm: f64) -> (Vec<Claim>, Vec<(&'static str, String)>) {
    // The fixture on pixels that show lines.
    let mut fine = recipe("square-200");
    fine.pixels = [2001, 2001];
    let part = make(&fine).expect("a plate").surface;
    let spot = Spot(vec![(1000.0, sigma_mm)]);
    let tif = spot.on(PIXEL_MM);
    let (vrr, overscan_mm) = (tif.vrr_nm_mm2_per_s(), tif.half_size_mm()[0]);
    // The machine is such that its largest feed asks for the widest pitch in the first class, Eq. 9.
    let first_nm = 0.5 * pv(part.height_nm()) / CLASSES as f64;
    let max_velocity_mm_per_s = vrr / (WIDEST_MM * first_nm);

    let settings = MultiPitchSettings {
        classes: CLASSES,
        max_velocity_mm_per_s,
        min_pitch_mm: 0.05,
        max_pitch_mm: WIDEST_MM,
        min_area_mm2: None,
        step_mm: 1.0,
        overscan_mm,
        links: Links::Outside,
    };
    let with = |links| {
        multi_pitch(&part, &tif, &MultiPitchSettings { links, ..settings.clone() }).expect("a path")
    };
    let several = with(Links::Outside);
    let pitch_mm: Vec<f64> = several.report.classes.iter().map(|c| c.pitch_mm).collect();
    let class = |region: i64| several.report.regions[region as usize].class;
    let one = RasterSettings::new(WIDEST_MM, 1.0, overscan_mm);
    let one = raster(&part, &one).expect("a raster");

    let run = |path: &ToolPath| execute(&part, &tif, path, max_velocity_mm_per_s);
    let uniform = run(&one);
    let multi = run(&several.path);
    let [linked, apart] = [Links::On, Links::Off].map(|links| run(&with(links).path));
    let of_mrf = Mrf::new(&part, &fine, sigma_mm, &settings, &one);

    let classes = several.region_idx.map(|region| class(*region) as i64);
    let inside = interior(&classes, (RIM_MM / PIXEL_MM) as usize);
    let [of_uniform, of_multi] = [&uniform, &multi].map(|r| largest_ripples(&r.ripple_nm, &inside));
    let [mrf_uniform, mrf_multi] =
        [&of_mrf.uniform, &of_mrf.multi].map(|r| largest_ripples(&r.ripple_nm, &inside));
    let spectra = [&uniform, &multi].map(|r| spectrum(&r.residual));
    let at_lines = spectra.each_ref().map(|s| at_frequency(s, 1.0 / WIDEST_MM));
    let beside = spectra.each_ref().map(|s| at_frequency(s, 0.8 / WIDEST_MM));
    let waves = |nm: &[f64]| {
        let text: Vec<String> = nm.iter().map(|v| format!("{:.4}", v / WAVE_NM)).collect();
        format!("{} lambda", text.join(" / "))
    };
    let below = |nm: &[f64], limit: f64| nm.iter().all(|v| *v < limit * WAVE_NM);
    let ascending = of_uniform.windows(2).all(|w| w[0] < w[1]);
    let rms = [&uniform, &multi, &linked, &apart].map(|r| r.residual.statistics().rms);
    let mean_feed = [&uniform, &multi].map(|r| r.length_mm / r.time_s / max_velocity_mm_per_s);
    // Eq. 12 at the largest feed: r = s / (d v)
    let least_um = |d: f64| 1e-3 * vrr / (d * max_velocity_mm_per_s);
    let densest_mm = pitch_mm[pitch_mm.len() - 1];

    let rows = vec![
        Claim::elsewhere("PV that the uniform path leaves (Fig. 13)", "um", 0.095, uniform.pv_um(), 0.5).remark(format!(
            "another part and tool; {} um of it is what the largest feed removes where nothing should be",
            significant(least_um(WIDEST_MM), 2)
        )),
        Claim::number("PV that the multi-pitch path leaves, tool lifted along borders (`--links outside`)", "um", 0.095, multi.pv_um(), 0.25)
            .remark("its extremes are at borders of regions"),
        Claim::number("the same, tool off on all links (`--links off`)", "um", 0.095, apart.pv_um(), 0.25),
        Claim::number("the same, tool on along all links (`--links on`)", "um", 0.095, linked.pv_um(), 0.25).differs(
            "links along a border remove beside the lines; Eq. 12 does not know them, a dwell solver does",
        ),
        Claim::check(
            "the multi-pitch path converges as far as the uniform one (RMS; uniform; multi-pitch with links outside, off, on)",
            format!(
                "{} / {} / {} / {} nm",
                significant(rms[0], 3),
                significant(rms[1], 3),
                significant(rms[3], 3),
                significant(rms[2], 3)
            ),
            rms[1] < 1.1 * rms[0] && rms[2] > 1.5 * rms[0],
        )
        .remark("only where the tool is lifted along borders"),
        Claim::statement(
            "ripple of the uniform path rises with the depth, beyond 0.01 lambda (largest PV in the four classes of depth)",
            "0.008 / 0.02 / 0.04 / 0.06 lambda",
            waves(&of_uniform),
            ascending && of_uniform[CLASSES - 1] > 0.015 * WAVE_NM,
        ),
        Claim::number(
            "the largest of them",
            "lambda",
            0.06,
            of_uniform[CLASSES - 1] / WAVE_NM,
            0.2,
        )
        .differs(format!(
            "the paper's TIF is not published: ours leaves {} % of the removal as ripple, theirs must leave {} %",
            significant(100.0 * spot.relative_ripple(WIDEST_MM), 2),
            significant(100.0 * 0.06 * WAVE_NM / pv(part.height_nm()), 2)
        )),
        Claim::number(
            "the same with the D-shaped spot of magnetorheological finishing, as wide across the lines (standard deviation)",
            "lambda",
            0.06,
            mrf_uniform[CLASSES - 1] / WAVE_NM,
            0.2,
        )
        .differs(format!(
            "its shape alone leaves {} times as much as a Gaussian; the size of the paper's spot is not published",
            significant(mrf_uniform[CLASSES - 1] / of_uniform[CLASSES - 1], 2)
        )),
        Claim::statement(
            "ripple of the multi-pitch path, in the same classes",
            "below 0.01 lambda in all",
            waves(&of_multi),
            below(&of_multi, 0.01),
        ),
        Claim::statement(
            "the same with the D-shaped spot",
            "below 0.01 lambda in all",
            waves(&mrf_multi),
            below(&mrf_multi, 0.01),
        )
        .differs("the first class has the lines of the uniform path, and this spot leaves more of them"),
        Claim::statement(
            "the spectrum of what the uniform path leaves has a peak at its lines, 1.25 /mm (density there over that at 1 /mm; uniform and multi-pitch)",
            "it has, and the multi-pitch path has none (Figs 14 and 15)",
            format!("{} and {}", significant(at_lines[0] / beside[0], 2), significant(at_lines[1] / beside[1], 2)),
            at_lines[0] > 10.0 * beside[0] && at_lines[1] < 2.0 * beside[1],
        ),
        Claim::check(
            "that peak, multi-pitch over uniform",
            significant(at_lines[1] / at_lines[0], 2),
            at_lines[1] < 0.1 * at_lines[0],
        ),
        Claim::statement(
            "paths dense enough for the deep places remove too much in the shallow ones (least removal of the narrowest pitch everywhere)",
            "too much",
            format!("{} um of {} um", significant(least_um(densest_mm), 3), significant(1e-3 * pv(part.height_nm()), 3)),
            1e3 * least_um(densest_mm) > 0.5 * pv(part.height_nm()),
        )
        .by_arithmetic("VRR / (pitch x largest feed), Eq. 12"),
        Claim::statement(
            "several pitches keep the feed high (mean feed over the largest, uniform and multi-pitch)",
            "they do",
            format!("{} and {}", significant(mean_feed[0], 2), significant(mean_feed[1], 2)),
            mean_feed[1] > 2.0 * mean_feed[0],
        )
        .remark("three times the length in the same time"),
    ];
    let pitches: Vec<String> = pitch_mm.iter().map(|p| significant(*p, 2)).collect();
    let titles =
        ["uniform, 0.80 mm".to_owned(), format!("multi-pitch, {} mm", pitches.join(" / "))];
    let [a, b] = titles;
    let deepest = deepest_ripple(&uniform.ripple_nm, &inside);
    let figures = vec![
        ("plate", maps(&[(a, &uniform.residual), (b, &multi.residual)], 20, 20.0, SECTION_MM)),
        ("plate-ripple", ripple_figure(&[&uniform, &multi], deepest)),
        ("plate-psd", spectrum_figure(&spectra)),
    ];
    (rows, figures)
}

/// Row and column in the deepest class where the ripple is largest.
fn deepest_ripple(ripple_nm: &Array2<f64>, inside: &Array2<i64>) -> (usize, usize) {
    let deep = inside.indexed_iter().filter(|(_, class)| **class == CLASSES as i64 - 1);
    let (place, _) = deep
        .max_by(|(a, _), (b, _)| ripple_nm[*a].total_cmp(&ripple_nm[*b]))
        .expect("the deepest class has an interior");
    place
}

/// Ripple across the lines, 4 mm to both sides of a pixel.
fn ripple_figure(runs: &[&Run; 2], (row, column): (usize, usize)) -> String {
    let series = |name, run: &Run| Series {
        name,
        points: (0..=80)
            .map(|k| {
                [PIXEL_MM * f64::from(k) - 4.0, run.ripple_nm[[row + k as usize - 40, column]]]
            })
            .collect(),
        dots: false,
    };
    chart(
        &Axis {
            label: "across the lines, mm",
            ticks: vec![-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0],
            log: false,
        },
        &Axis {
            label: "ripple where most is removed, nm",
            ticks: vec![-8.0, -6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0, 8.0, 10.0],
            log: false,
        },
        &[series("uniform, 0.8 mm", runs[0]), series("multi-pitch, 0.13 mm there", runs[1])],
    )
}

/// Runs on the same plate and paths with the D-shaped spot of magnetorheological finishing (its process: W.
/// I. Kordonski and others, Optical Fabrication and Testing 1998, doi 10.1364/oft.1998.omd.1). Its removal
/// across the lines has the same standard deviation. The flow is along the lines.
struct Mrf {
    uniform: Run,
    multi: Run,
}

impl Mrf {
    fn new(
        part: &Surface,
        plate: &Recipe,
        sigma_mm: f64,
        settings: &MultiPitchSettings,
        one: &ToolPath,
    ) -> Self {
        let spot = |width_mm: f64| {
            // The proportions of the spot of `square-200`.
            let shape = Shape::Mrf { length_mm: 1.2 * width_mm, width_mm };
            let tif =
                TifRecipe { peak_nm_per_s: 1000.0, half_size_mm: 14.0 / 2.5 * width_mm, shape };
            make(&Recipe { tif, ..plate.clone() }).expect("a spot").tif
        };
        let first = spot(sigma_mm);
        let tif = spot(sigma_mm * sigma_mm / across_mm(&first));
        let overscan_mm = tif.half_size_mm()[0];
        // The largest feed asks for the same pitches.
        let first_nm = 0.5 * pv(part.height_nm()) / CLASSES as f64;
        let max_velocity_mm_per_s = tif.vrr_nm_mm2_per_s() / (WIDEST_MM * first_nm);
        let settings =
            MultiPitchSettings { max_velocity_mm_per_s, overscan_mm, ..settings.clone() };
        let several = multi_pitch(part, &tif, &settings).expect("a path");
        let run = |path: &ToolPath| execute(part, &tif, path, max_velocity_mm_per_s);
        Self { uniform: run(one), multi: run(&several.path) }
    }
}

/// Standard deviation along y of the removal by a TIF, mm.
fn across_mm(tif: &Tif) -> f64 {
    let (rate, y) = (tif.rate_nm_per_s(), tif.grid().y);
    let moment = |k: i32| -> f64 {
        rate.outer_iter().enumerate().map(|(r, row)| row.sum() * y.coordinate_mm(r).powi(k)).sum()
    };
    (moment(2) / moment(0) - (moment(1) / moment(0)).powi(2)).sqrt()
}

/// Dwell times by the feed law (Eq. 12), executed at constant feeds.
fn execute(part: &Surface, tif: &Tif, path: &ToolPath, max_velocity_mm_per_s: f64) -> Run {
    let least = Bound::SecondsPerMm(1.0 / max_velocity_mm_per_s);
    let law = feed_law::dwell(part, tif, path, least, &feed_law::FeedLawSettings::default());
    let (dwell, _) = law.expect("dwell times");
    let motion = average_velocity::schedule(path, &dwell, &ion_beam()).expect("a motion");
    let done = simulate(&motion.trajectory, tif, part, Settings::Gridded).expect("a removal");
    Run {
        residual: done.removal.residual().clone(),
        ripple_nm: ripple_nm(done.removal.removal_nm()),
        time_s: motion.trajectory.total_time_s(),
        length_mm: (0..path.len()).map(|i| path.segment_length_mm(i)).sum(),
    }
}

fn spectrum(residual: &Surface) -> Psd {
    let settings =
        PsdSettings { window: Window::Hann, detrend: Detrend::Plane, band_per_mm: Vec::new() };
    psd(residual, &settings).expect("a spectrum")
}

/// Largest density across the lines within 2 % of a frequency, nm^2 mm.
fn at_frequency(spectrum: &Psd, per_mm: f64) -> f64 {
    let near = |f: f64| (f / per_mm - 1.0).abs() < 0.02;
    let of = spectrum.frequency_y_per_mm.iter().zip(&spectrum.psd_y_nm2_mm);
    of.filter(|(f, _)| near(**f)).fold(0.0, |m, (_, d)| m.max(*d))
}

/// Figs 14 and 15: spectra across the lines.
fn spectrum_figure(spectra: &[Psd; 2]) -> String {
    let series = |name, s: &Psd| Series {
        name,
        points: s
            .frequency_y_per_mm
            .iter()
            .zip(&s.psd_y_nm2_mm)
            .filter(|(f, _)| (0.01..=5.0).contains(*f))
            .map(|(f, d)| [*f, d.max(1e-8)])
            .collect(),
        dots: false,
    };
    chart(
        &Axis {
            label: "spatial frequency across the lines, 1/mm",
            ticks: vec![0.01, 0.1, 1.0, 10.0],
            log: true,
        },
        &Axis {
            label: "density of what is left, nm^2 mm",
            ticks: (-4..=2).map(|k| 100.0_f64.powi(k)).collect(),
            log: true,
        },
        &[series("uniform, 0.8 mm", &spectra[0]), series("multi-pitch", &spectra[1])],
    )
}

/// The removal without its mean over one widest pitch along y; zero at the edges.
fn ripple_nm(removal_nm: &Array2<f64>) -> Array2<f64> {
    let half = PERIOD / 2;
    let (ny, nx) = removal_nm.dim();
    let mut ripple = Array2::zeros((ny, nx));
    for r in half..ny - half {
        for c in 0..nx {
            // A whole period: its ends count half.
            let ends = removal_nm[[r - half, c]] + removal_nm[[r + half, c]];
            let inner: f64 = (r + 1 - half..r + half).map(|k| removal_nm[[k, c]]).sum();
            ripple[[r, c]] = removal_nm[[r, c]] - (0.5 * ends + inner) / PERIOD as f64;
        }
    }
    ripple
}

/// The class of pixels whose neighbourhood of `reach` pixels is of that class; -1 elsewhere.
fn interior(class: &Array2<i64>, reach: usize) -> Array2<i64> {
    let along_rows = |map: &Array2<i64>| {
        let mut kept = Array2::from_elem(map.dim(), -1);
        for (r, row) in map.outer_iter().enumerate() {
            let mut start = 0;
            for c in 0..=row.len() {
                if c == row.len() || row[c] != row[start] {
                    // A run from start to c - 1.
                    for k in start + reach..c.saturating_sub(reach).max(start + reach) {
                        kept[[r, k]] = row[start];
                    }
                    start = c;
                }
            }
        }
        kept
    };
    let rows = along_rows(class);
    along_rows(&rows.t().to_owned()).t().to_owned()
}

/// PV within one pitch, the largest of every class, nm.
fn largest_ripples(ripple_nm: &Array2<f64>, inside: &Array2<i64>) -> Vec<f64> {
    let mut largest = vec![0.0_f64; CLASSES];
    let (ny, nx) = ripple_nm.dim();
    for r in 0..ny - PERIOD {
        for c in 0..nx {
            if let Ok(class) = usize::try_from(inside[[r, c]]) {
                let period = ripple_nm.slice(s![r..=r + PERIOD, c]);
                let (low, high) =
                    period.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
                largest[class] = largest[class].max(high - low);
            }
        }
    }
    largest
}
