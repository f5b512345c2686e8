//! The plate of the multi-pitch paper (Fig. 13): rasters of one and of several pitches at the feed of
//! Eq. 12, executed and predicted.

use ndarray::{Array2, s};
use planish_fixture::make;
use planish_schedule::average_velocity;
use planish_simulate::{Settings, simulate};
use planish_testkit::ion_beam;
use planish_toolpath::{
    LineOrder, RasterSettings, Scan, Turn,
    multi_pitch::{Links, MultiPitchSettings, multi_pitch},
    raster,
};
use planish_types::{DwellTime, Surface, Tif, ToolPath};

use crate::{
    claim::{Claim, significant},
    figure::{Axis, Series, chart, maps},
    lines::Spot,
    recipe,
};

/// Widest pitch, and the lines of the uniform raster, mm.
const WIDEST_MM: f64 = 0.8;
const CLASSES: usize = 4;
const PIXEL_MM: f64 = 0.1;
/// Pixels per widest pitch.
const PERIOD: usize = 8;
/// Ripple is measured farther than this from borders of regions and of the plate: 10 sigma.
const RIM_MM: f64 = 4.0;
/// A section that crosses all four classes of depth.
const SECTION_MM: f64 = 120.0;
/// HeNe, the unit of the paper.
const WAVE_NM: f64 = 632.8;

/// What a path leaves.
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
    let one = RasterSettings {
        pitch_mm: WIDEST_MM,
        step_mm: 1.0,
        overscan_mm,
        scan: Scan::X,
        turn: Turn::Square,
        line_origin_mm: None,
        order: LineOrder::Sequential,
        one_directional: false,
        pitch_range_mm: None,
    };
    let one = raster(&part, &one).expect("a raster");

    let run = |path: &ToolPath, pitch: &dyn Fn(usize) -> f64| {
        let dwell = feed(&part, path, pitch, vrr, max_velocity_mm_per_s);
        execute(&part, &tif, path, &dwell)
    };
    // Regions and their order are the same whatever the links.
    let of_regions = |path: &ToolPath| run(path, &|i| pitch_mm[class(path.pass_idx()[i])]);
    let uniform = run(&one, &|_| WIDEST_MM);
    let multi = of_regions(&several.path);
    let [linked, apart] = [Links::On, Links::Off].map(|links| of_regions(&with(links).path));

    let classes = several.region_idx.map(|region| class(*region) as i64);
    let inside = interior(&classes, (RIM_MM / PIXEL_MM) as usize);
    let [of_uniform, of_multi] = [&uniform, &multi].map(|r| largest_ripples(&r.ripple_nm, &inside));
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
        Claim::at_most("PV that the uniform path leaves (Fig. 13)", "um", 0.095, uniform.pv_um()).remark(format!(
            "another part and tool; {} um of it is what the largest feed removes where nothing should be",
            significant(least_um(WIDEST_MM), 2)
        )),
        Claim::number("PV that the multi-pitch path leaves, tool lifted along borders (`--links outside`)", "um", 0.095, multi.pv_um(), 0.25)
            .remark("its extremes are at borders of regions"),
        Claim::number("the same, tool off on all links (`--links off`)", "um", 0.095, apart.pv_um(), 0.25),
        Claim::number("the same, tool on on all links (`--links on`)", "um", 0.095, linked.pv_um(), 0.25).differs(
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
        Claim::statement(
            "ripple of the multi-pitch path, in the same classes",
            "below 0.01 lambda in all",
            waves(&of_multi),
            below(&of_multi, 0.01),
        ),
        Claim::statement(
            "paths dense enough for the deep places remove too much in the shallow ones (least removal of the narrowest pitch everywhere)",
            "too much",
            format!("{} um of {} um", significant(least_um(densest_mm), 3), significant(1e-3 * pv(part.height_nm()), 3)),
            1e3 * least_um(densest_mm) > 0.5 * pv(part.height_nm()),
        ),
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

fn along_a_line(path: &ToolPath, i: usize) -> bool {
    path.displacement_mm(i)[1].abs() < 1e-9
}

/// Eq. 12: the feed s / (d r), at most the largest one; on links between lines the largest one.
fn feed(
    part: &Surface,
    path: &ToolPath,
    pitch_mm: &dyn Fn(usize) -> f64,
    vrr: f64,
    max_velocity_mm_per_s: f64,
) -> DwellTime {
    let grid = part.grid();
    let near = |v: f64, n: usize| (v.round().max(0.0) as usize).min(n - 1);
    let depth_nm = |p: [f64; 2]| {
        let c = near((p[0] - grid.x.start_mm()) / PIXEL_MM, grid.x.len());
        let r = near((p[1] - grid.y.start_mm()) / PIXEL_MM, grid.y.len());
        // The mean over half a millimetre, so that the noise of a pixel does not become a feed.
        let around = |k: usize, n: usize| k.saturating_sub(2)..(k + 3).min(n);
        let part = part.height_nm().slice(s![around(r, grid.y.len()), around(c, grid.x.len())]);
        part.sum() / part.len() as f64
    };
    let dwell_s = (0..path.len()).map(|i| {
        let least = 1.0 / max_velocity_mm_per_s;
        let density = match along_a_line(path, i) {
            true => (pitch_mm(i) * depth_nm(path.dwell_point_mm()[i]) / vrr).max(least),
            false => least,
        };
        density * path.segment_length_mm(i)
    });
    DwellTime::new(dwell_s.collect()).expect("dwell times")
}

fn execute(part: &Surface, tif: &Tif, path: &ToolPath, dwell: &DwellTime) -> Run {
    let motion = average_velocity::schedule(path, dwell, &ion_beam()).expect("a motion");
    let done = simulate(&motion.trajectory, tif, part, Settings::Gridded).expect("a removal");
    Run {
        residual: done.removal.residual().clone(),
        ripple_nm: ripple_nm(done.removal.removal_nm()),
        time_s: motion.trajectory.total_time_s(),
        length_mm: (0..path.len()).map(|i| path.segment_length_mm(i)).sum(),
    }
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
