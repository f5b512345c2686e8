//! Every statement of `docs/conventions.md` is a test of the same name here.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

use ndarray::Array2;
use planish_dwell::bounded_least_squares::{self, Bound};
use planish_handoff::kind;
use planish_numerics::statistics;
use planish_schedule::{baselines::position, pvt};
use planish_simulate::simulate;
use planish_testkit::{ion_beam, machine, workspace};
use planish_types::{
    Axis, ClearAperture, DwellTime, Grid, Limits, MachineFile, Removal, Surface, Tif, ToolPath,
    Trajectory,
};
use planish_verify::{Verdict, VerifySettings, verify};

// ---------------------------------------------------------------------------------------------
// The page and the tests

/// The names that the page gives to its statements: "- `name`: ..." .
fn statements() -> Vec<String> {
    let page = fs::read_to_string(workspace().join("docs/conventions.md")).unwrap();
    let name = |line: &str| Some(line.strip_prefix("- `")?.split_once("`: ")?.0.to_string());
    page.lines().filter_map(name).collect()
}

/// Tests that are about the text, not about statements of the page.
const ABOUT_TEXT: [&str; 6] = [
    "the_page_and_the_tests_say_the_same",
    "retired_words_stay_out",
    "constants_say_what_they_decide",
    "functions_can_be_read",
    "lines_of_pages_can_be_read",
    "pages_that_are_named_exist",
];

#[test]
fn the_page_and_the_tests_say_the_same() {
    let this = workspace().join("crates/testkit/tests/conventions.rs");
    let source = fs::read_to_string(this).unwrap();
    let name = |part: &str| Some(part.strip_prefix("\nfn ")?.split_once('(')?.0.to_string());
    let tests: BTreeSet<String> = source
        .split("#[test]")
        .filter_map(name)
        .filter(|name| !ABOUT_TEXT.contains(&name.as_str()))
        .collect();
    let listed = statements();
    let statements: BTreeSet<String> = listed.iter().cloned().collect();
    assert_eq!(listed.len(), statements.len(), "a statement occurs twice");
    let untested: Vec<_> = statements.difference(&tests).collect();
    assert!(untested.is_empty(), "statements without a test: {untested:?}");
    let unstated: Vec<_> = tests.difference(&statements).collect();
    assert!(unstated.is_empty(), "tests without a statement: {unstated:?}");
    assert!(statements.len() > 20);
}

// ---------------------------------------------------------------------------------------------
// Words and lines

/// Retired words: the word, the beginning of the paths in which it is forbidden, and the word of the field
/// to write instead.
const RETIRED: [(&str, &str, &str); 13] = [
    ("stand-in", "", "surrogate"),
    ("stand_in", "", "surrogate"),
    ("envelope", "crates/numerics/", "skyline"),
    ("envelope matrix", "", "skyline matrix"),
    ("behind", "", "after or beyond"),
    ("dead", "", "unreached"),
    ("live", "crates/dwell/", "reached"),
    ("leak", "crates/simulate/", "kernel spill"),
    ("leaks", "crates/simulate/", "spills over"),
    ("leak", "crates/dwell/", "kernel spill"),
    ("leaks", "crates/dwell/", "spills over"),
    ("share of the", "crates/", "fraction of the"),
    ("seed formulation", "", "PVT as published"),
];

/// Names of constants that say nothing about what the constant decides.
const EMPTY_NAMES: [&str; 14] = [
    "SETS", "SOME", "MOST", "ENOUGH", "CLEARLY", "TOGETHER", "LARGE", "LARGEST", "SMALL", "FEW",
    "MANY", "NEAR", "WEAK", "TINY",
];

/// Largest number of characters of a line of a page, except tables, fenced blocks, headings and addresses.
/// Larger: lines are hard to read and to compare. Smaller: more breaks.
const LINE: usize = 120;

/// The texts of the project with their paths from its folder: sources, scripts and pages.
fn texts() -> Vec<(String, String)> {
    fn walk(dir: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(dir).unwrap().map(Result::unwrap) {
            let path = entry.path();
            let name = entry.file_name().into_string().unwrap();
            if path.is_dir() {
                let made = ["target", "out", "corpus", "data"].contains(&name.as_str());
                if !made && !name.starts_with('.') {
                    walk(&path, found);
                }
            } else if ["rs", "md", "py", "js", "sh", "just"]
                .iter()
                .any(|e| name.ends_with(&format!(".{e}")))
                || name == "justfile"
            {
                found.push(path);
            }
        }
    }
    let mut paths = Vec::new();
    walk(&workspace(), &mut paths);
    let name = |path: &PathBuf| {
        let inside = path.strip_prefix(workspace()).unwrap();
        inside.to_str().unwrap().replace('\\', "/")
    };
    let mut texts: Vec<_> =
        paths.iter().map(|path| (name(path), fs::read_to_string(path).unwrap())).collect();
    texts.retain(|(name, _)| name != "crates/testkit/tests/conventions.rs");
    texts.sort();
    assert!(texts.len() > 200, "{} texts", texts.len());
    texts
}

/// Returns true if `line` holds `word` without a letter or a digit next to it.
fn holds(line: &str, word: &str) -> bool {
    let line = line.to_lowercase();
    let touches = |c: Option<char>| c.is_some_and(|c| c.is_alphanumeric() || c == '_');
    line.match_indices(word).any(|(i, _)| {
        !touches(line[..i].chars().next_back()) && !touches(line[i + word.len()..].chars().next())
    })
}

#[test]
fn retired_words_stay_out() {
    assert!(holds("A stand-in for it.", "stand-in") && !holds("deadline", "dead"));
    let mut found = Vec::new();
    for (name, text) in texts() {
        for (number, line) in text.lines().enumerate() {
            for (word, place, instead) in RETIRED {
                if name.starts_with(place) && holds(line, word) {
                    found.push(format!("{name}:{}: {word}; write {instead}", number + 1));
                }
            }
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn constants_say_what_they_decide() {
    let mut found = Vec::new();
    for (name, text) in texts().into_iter().filter(|(name, _)| name.ends_with(".rs")) {
        for (number, line) in text.lines().enumerate() {
            let declared = line.split_once("const ").and_then(|(_, rest)| rest.split_once(':'));
            if declared.is_some_and(|(constant, _)| EMPTY_NAMES.contains(&constant)) {
                found.push(format!("{name}:{}: {}", number + 1, line.trim()));
            }
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

/// Largest number of lines of a function, from its signature to its end. Larger: functions that do several things.
/// Smaller: parts that nothing but their caller can use.
const FUNCTION: usize = 80;

/// Longer functions, and the reason for which each stays whole.
const LONG_FUNCTIONS: [(&str, &str, &str); 1] =
    [("crates/testkit/src/hostile.rs", "inputs", "a table")];

/// The functions of a formatted source before its tests, each with the number of its lines.
fn functions(source: &str) -> Vec<(String, usize)> {
    let code: Vec<&str> = source.lines().take_while(|line| *line != "#[cfg(test)]").collect();
    let mut found = Vec::new();
    for (i, line) in code.iter().enumerate() {
        let start = line.trim_start();
        let words = || start.split(' ');
        let Some(at) = words().position(|word| word == "fn") else { continue };
        let before =
            words().take(at).all(|w| w.starts_with("pub") || ["const", "unsafe"].contains(&w));
        if !before || line.ends_with(['}', ';']) {
            continue;
        }
        let name = words().nth(at + 1).unwrap_or_default();
        let name = name.split(['(', '<']).next().unwrap_or_default();
        let end = format!("{}}}", &line[..line.len() - start.len()]);
        if let Some(lines) = code[i..].iter().position(|line| *line == end) {
            found.push((name.to_string(), lines + 1));
        }
    }
    found
}

#[test]
fn functions_can_be_read() {
    let example = "impl A {\n    pub fn f<T>(\n        t: T,\n    ) {\n        let a = b;\n    }\n}\nfn g() {}\n";
    assert_eq!(functions(example), [("f".to_string(), 5)]);
    let mut found = Vec::new();
    let mut is_long = [false; LONG_FUNCTIONS.len()];
    for (file, text) in texts() {
        if !file.ends_with(".rs") || !file.starts_with("crates/") || !file.contains("/src/") {
            continue;
        }
        for (name, lines) in functions(&text).into_iter().filter(|(_, lines)| *lines > FUNCTION) {
            match LONG_FUNCTIONS.iter().position(|(f, n, _)| (*f, *n) == (&file, &name)) {
                Some(listed) => is_long[listed] = true,
                None => found.push(format!("{file}: {name} has {lines} lines; split it")),
            }
        }
    }
    for ((file, name, _), _) in LONG_FUNCTIONS.iter().zip(is_long).filter(|(_, long)| !long) {
        found.push(format!("{file}: {name} is short; take it off the list"));
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn lines_of_pages_can_be_read() {
    let mut found = Vec::new();
    for (name, text) in texts().into_iter().filter(|(name, _)| name.ends_with(".md")) {
        let mut fenced = false;
        for (number, line) in text.lines().enumerate() {
            fenced ^= line.starts_with("```");
            let linked = line.contains("](http");
            let free = fenced || linked || line.starts_with(['|', '#']);
            if !free && line.chars().count() > LINE {
                found.push(format!("{name}:{}: {} characters", number + 1, line.chars().count()));
            }
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn pages_that_are_named_exist() {
    let mut found = Vec::new();
    for (name, text) in texts() {
        let here = workspace().join(&name);
        for (number, line) in text.lines().enumerate() {
            let mut named = Vec::new();
            // [words](target)
            if name.ends_with(".md") {
                let targets = line.split("](").skip(1).filter_map(|rest| rest.split_once(')'));
                let local = targets.map(|(target, _)| target).filter(|t| !t.contains("://"));
                named.extend(local.map(|t| here.with_file_name(t.split('#').next().unwrap_or(t))));
            }
            // docs/page.md
            for (i, _) in line.match_indices("docs/") {
                let inside = |c: char| c.is_ascii_alphanumeric() || "_-./".contains(c);
                let path: String = line[i..].chars().take_while(|c| inside(*c)).collect();
                let within = line[..i].ends_with(['/', '}', '_']);
                if path.ends_with(".md") && !within {
                    named.push(workspace().join(path));
                }
            }
            let missing = named.iter().filter(|path| !path.exists());
            found.extend(missing.map(|p| format!("{name}:{}: {}", number + 1, p.display())));
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

// ---------------------------------------------------------------------------------------------
// Small things to test with

fn grid(x: (f64, f64, usize), y: (f64, f64, usize)) -> Grid {
    Grid { x: Axis::new(x.0, x.1, x.2).unwrap(), y: Axis::new(y.0, y.1, y.2).unwrap() }
}

/// 40 x 30 pixels of 0.25 mm; x from 10 mm, y from -5 mm.
fn part() -> Grid {
    grid((10.0, 0.25, 40), (-5.0, 0.25, 30))
}

fn flat(grid: Grid) -> Surface {
    Surface::new(grid, Array2::zeros(grid.shape())).unwrap()
}

/// A Gaussian of 8 nm/s and sigma 0.5 mm on 17 x 17 samples of 0.25 mm.
fn gaussian() -> Tif {
    let g = grid((-2.0, 0.25, 17), (-2.0, 0.25, 17));
    let rate = |(r, c): (usize, usize)| {
        8.0 * (-(g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2))
            / (2.0 * 0.5_f64.powi(2)))
        .exp()
    };
    Tif::new(g, Array2::from_shape_fn(g.shape(), rate)).unwrap()
}

/// A TIF of 1 nm/s at one of 9 x 9 samples of 0.25 mm, 0 at the others.
fn one_sample(row: usize, column: usize) -> Tif {
    let g = grid((-1.0, 0.25, 9), (-1.0, 0.25, 9));
    let mut rate = Array2::zeros(g.shape());
    rate[[row, column]] = 1.0;
    Tif::new(g, rate).unwrap()
}

/// A tool that stands at `at` for `time_s`.
fn standing(at: [f64; 2], time_s: f64) -> Trajectory {
    let c = at.map(|p| [p, 0.0, 0.0, 0.0]);
    Trajectory::new(vec![0.0, time_s], vec![c], vec![true], vec![Some(0)]).unwrap()
}

/// A straight path along x.
fn straight(x: &[f64], y: f64) -> ToolPath {
    let n = x.len() - 1;
    ToolPath::through(x.iter().map(|x| [*x, y]).collect(), vec![true; n], vec![0; n]).unwrap()
}

fn removal(trajectory: &Trajectory, tif: &Tif, desired: &Surface) -> Removal {
    simulate(trajectory, tif, desired, planish_simulate::SimulationSettings::Gridded)
        .unwrap()
        .removal
}

fn judge(trajectory: &Trajectory, limits: &Limits) -> Verdict {
    verify(trajectory, limits, &VerifySettings::default()).unwrap()
}

/// Row and column of the largest value.
fn peak(map: &Array2<f64>) -> (usize, usize) {
    map.indexed_iter().max_by(|a, b| a.1.total_cmp(b.1)).unwrap().0
}

fn near(found: f64, expected: f64, tolerance: f64) {
    assert!((found - expected).abs() <= tolerance, "found {found}, expected {expected}");
}

/// Rounding of an FFT over values of the order of 10 to 100.
const FFT_ROUNDING: f64 = 1e-10;

// ---------------------------------------------------------------------------------------------
// Units

#[test]
fn units_are_in_the_names() {
    let arrays = kind::ALL.iter().flat_map(|k| k.arrays);
    for array in arrays.filter(|a| a.unit != "1") {
        let unit = match array.unit {
            // Coefficients of four orders share one name.
            "mm/s^order" => "mm".to_string(),
            // Linear and rotary axes share an array.
            "mm/s^order, deg/s^order" => "mm_or_deg".to_string(),
            // 1/mm is per_mm, nm^2 mm is nm2_mm.
            unit => {
                unit.replace("1/", "per_").replace('/', "_per_").replace('^', "").replace(' ', "_")
            }
        };
        assert!(array.name.ends_with(&format!("_{unit}")), "{} in {}", array.name, array.unit);
    }
    let mut machine = MachineFile::from(&ion_beam());
    machine.axes[0].max_jerk_mm_per_s3 = Some(1.0);
    let axis = serde_json::to_value(&machine.axes[0]).unwrap();
    let names: Vec<&String> = axis.as_object().unwrap().keys().collect();
    assert_eq!(
        names,
        ["name", "max_velocity_mm_per_s", "max_acceleration_mm_per_s2", "max_jerk_mm_per_s3"]
    );
}

#[test]
fn lengths_are_mm_heights_nm_times_s() {
    let mut units: BTreeSet<&str> =
        kind::ALL.iter().flat_map(|k| k.arrays).map(|a| a.unit).collect();
    let spectral = ["1/mm", "nm^2 mm", "nm^2 mm^2", "nrad^2 mm", "nrad^2 mm^2"];
    let plain = ["mm", "mm^2", "nm", "nrad", "nm/s", "s", "s/mm", "1", "deg"];
    let of_motions = ["mm/s^order", "mm/s^order, deg/s^order"];
    for known in plain.into_iter().chain(of_motions).chain(spectral) {
        assert!(units.remove(known), "no array in {known}");
    }
    assert!(units.is_empty(), "{units:?}");
}

#[test]
fn removal_is_rate_times_time() {
    let at = [part().x.coordinate_mm(20), part().y.coordinate_mm(15)];
    let removal = removal(&standing(at, 3.0), &gaussian(), &flat(part()));
    near(removal.removal_nm()[[15, 20]], 8.0 * 3.0, FFT_ROUNDING);
}

#[test]
fn removed_volume_is_the_volumetric_rate_times_time() {
    let removal = removal(&standing([15.1, -1.3], 3.0), &gaussian(), &flat(part()));
    let volume = removal.removal_nm().sum() * part().pixel_mm2();
    // V = 2 pi A sigma^2 nm mm^2/s. The tool ends at 4 sigma, where 4e-4 of V is left.
    let rate = std::f64::consts::TAU * 8.0 * 0.25;
    near(volume / (3.0 * rate), 1.0, 1e-3);
    near(gaussian().vrr_nm_mm2_per_s() / rate, 1.0, 1e-3);
}

#[test]
fn motion_is_mm_per_s() {
    // p = 1 u + 2 u^2 + 3 u^3 for 1 s: v up to 1 + 4 + 9, a from 4 to 4 + 18.
    let t = Trajectory::new(
        vec![0.0, 1.0],
        vec![[[0.0, 1.0, 2.0, 3.0], [0.0; 4]]],
        vec![true],
        vec![Some(0)],
    );
    let verdict = judge(&t.unwrap(), &ion_beam());
    assert_eq!(verdict.max_velocity_mm_per_s, [14.0, 0.0]);
    assert_eq!(verdict.max_acceleration_mm_per_s2, [22.0, 0.0]);
    assert_eq!(verdict.max_jerk_mm_per_s3, [18.0, 0.0]);
}

#[test]
fn dwell_density_is_s_per_mm() {
    // A map that asks for nothing: every dwell time stays at its least, density times length.
    let path = straight(&[13.0, 13.5, 15.0, 15.25], -1.0);
    let settings = bounded_least_squares::BoundedSettings {
        min_dwell: Bound::SecondsPerMm(0.2),
        ..Default::default()
    };
    let solution =
        bounded_least_squares::solve(&flat(part()), &gaussian(), &path, None, &settings).unwrap();
    for (found, length_mm) in solution.dwell.dwell_s().iter().zip([0.5, 1.5, 0.25]) {
        assert!(*found >= 0.2 * length_mm, "{found} s on {length_mm} mm");
        // Rounding of a product.
        near(*found, 0.2 * length_mm, 1e-12);
    }
}

// ---------------------------------------------------------------------------------------------
// Axes

#[test]
fn arrays_are_y_x() {
    assert_eq!(part().shape(), (30, 40));
    assert!(Surface::new(part(), Array2::zeros((40, 30))).is_err());
    let maps = kind::ALL.iter().flat_map(|k| k.arrays).filter(|a| a.shape == ["ny", "nx"]);
    assert_eq!(maps.map(|a| assert_eq!(a.axes, ["y", "x"], "{}", a.name)).count(), 11);
    let at = [part().x.coordinate_mm(33), part().y.coordinate_mm(4)];
    let removal = removal(&standing(at, 1.0), &gaussian(), &flat(part()));
    assert_eq!(peak(removal.removal_nm()), (4, 33));
}

#[test]
fn row_0_is_the_smallest_y() {
    let low = [14.0, part().y.start_mm()];
    let removal = removal(&standing(low, 1.0), &gaussian(), &flat(part()));
    assert_eq!(peak(removal.removal_nm()).0, 0);
}

#[test]
fn x_and_y_ascend_uniformly() {
    let axis = |mm: &[f64]| Axis::from_coordinates("x_mm", mm);
    assert!(axis(&[0.0, 0.5, 1.0]).is_ok());
    for bad in [[1.0, 0.5, 0.0], [0.0, 0.5, 1.1], [0.0, 0.0, 1.0]] {
        assert!(axis(&bad).is_err(), "{bad:?}");
    }
}

#[test]
fn a_pixel_is_its_centre() {
    // A tool at the coordinates of a pixel removes the same on both sides of it, and an aperture
    // holds the pixels whose centres it holds.
    let (r, c) = (12, 21);
    let at = [part().x.coordinate_mm(c), part().y.coordinate_mm(r)];
    let map = removal(&standing(at, 1.0), &gaussian(), &flat(part()));
    let map = map.removal_nm();
    for k in 1..6 {
        near(map[[r, c - k]], map[[r, c + k]], FFT_ROUNDING);
        near(map[[r - k, c]], map[[r + k, c]], FFT_ROUNDING);
    }
    let aperture = |half: f64| ClearAperture::Circle { centre_mm: at, radius_mm: half };
    let pixels = |half: f64| aperture(half).mask(&part()).unwrap().iter().filter(|m| **m).count();
    assert_eq!((pixels(0.249), pixels(0.25)), (1, 5));
}

#[test]
fn points_are_x_y() {
    let path = straight(&[13.0, 14.0], -2.0);
    assert_eq!(path.dwell_point_mm(), [[13.5, -2.0]]);
    let t = position::schedule(&path, &DwellTime::new(vec![1.0]).unwrap()).unwrap();
    let map = removal(&t, &gaussian(), &flat(part()));
    // x = 13.5 is column 14, y = -2 is row 12.
    assert_eq!(peak(map.removal_nm()), (12, 14));
}

// ---------------------------------------------------------------------------------------------
// Heights

#[test]
fn nan_is_an_invalid_pixel_and_is_skipped() {
    let g = grid((0.0, 1.0, 3), (0.0, 1.0, 2));
    let hole = ndarray::array![[1.0, f64::NAN, 3.0], [f64::NAN, 5.0, f64::NAN]];
    let desired = Surface::new(g, hole).unwrap();
    let s = desired.statistics();
    assert_eq!((s.valid_count, s.mean, s.min, s.max), (3, 3.0, 1.0, 5.0));
    // The removal is known everywhere, the residual where the map is.
    let removal = Removal::new(&desired, Array2::ones((2, 3))).unwrap();
    let residual = removal.residual().height_nm();
    assert!(residual[[0, 1]].is_nan() && residual[[1, 1]] == 4.0);
    let bad = Array2::from_elem((2, 3), f64::NAN);
    assert!(Surface::new(g, bad).is_err(), "a map has a valid pixel");
}

#[test]
fn height_positive_is_material_above_the_target() {
    // A hill at x = 17 gets more dwell time than the plain around it, a pit there less.
    let path = straight(&(0..=20).map(|i| 12.0 + 0.5 * f64::from(i)).collect::<Vec<_>>(), -1.5);
    let dwell = |sign: f64| {
        let height = |(r, c): (usize, usize)| {
            let (x, y) = (part().x.coordinate_mm(c) - 17.25, part().y.coordinate_mm(r) + 1.5);
            20.0 + sign * 10.0 * (-(x * x + y * y) / 2.0).exp()
        };
        let desired = Surface::new(part(), Array2::from_shape_fn(part().shape(), height)).unwrap();
        let settings = bounded_least_squares::BoundedSettings {
            min_dwell: Bound::Seconds(0.1),
            ..Default::default()
        };
        bounded_least_squares::solve(&desired, &gaussian(), &path, None, &settings).unwrap().dwell
    };
    let (hill, pit) = (dwell(1.0), dwell(-1.0));
    let longest =
        |t: &DwellTime| (0..20).max_by(|a, b| t.dwell_s()[*a].total_cmp(&t.dwell_s()[*b])).unwrap();
    assert!((9..=11).contains(&longest(&hill)), "{:?}", hill.dwell_s());
    assert!(hill.dwell_s()[10] > pit.dwell_s()[10]);
}

#[test]
fn removal_is_positive() {
    let map = removal(&standing([14.0, -2.0], 1.0), &gaussian(), &flat(part()));
    assert!(map.removal_nm().iter().all(|r| *r > -FFT_ROUNDING) && map.removal_nm().sum() > 0.0);
    let g = gaussian();
    assert!(Tif::new(*g.grid(), g.rate_nm_per_s().mapv(|r| -r)).is_err(), "a TIF that deposits");
}

#[test]
fn residual_is_desired_minus_removal() {
    let desired = Surface::new(part(), Array2::from_elem(part().shape(), 5.0)).unwrap();
    let result = removal(&standing([14.0, -2.0], 1.0), &gaussian(), &desired);
    for (z, r) in result.residual().height_nm().iter().zip(result.removal_nm()) {
        assert_eq!(*z, 5.0 - r);
    }
    assert!(result.residual().height_nm()[[12, 16]] < 0.0, "8 nm removed of 5: a hole is negative");
}

#[test]
fn rms_is_the_population_rms_without_the_mean() {
    // Of 1, 2, 3, 4: mean 5/2, mean square of the rest (9/4 + 1/4 + 1/4 + 9/4) / 4 = 5/4.
    let s = statistics::statistics(ndarray::array![[1.0, 2.0], [3.0, 4.0]].view()).unwrap();
    // One rounding of a root.
    near(s.rms, 1.25_f64.sqrt(), 1e-15);
}

#[test]
fn detilted_rms_is_without_the_best_plane() {
    let g = part();
    let plane =
        |(r, c): (usize, usize)| 3.0 + 0.5 * g.x.coordinate_mm(c) - 2.0 * g.y.coordinate_mm(r);
    let map = Surface::new(g, Array2::from_shape_fn(g.shape(), plane)).unwrap();
    // Rounding of heights of 20 nm.
    near(map.detilted_rms_nm(), 0.0, 1e-12);
    assert!(map.statistics().rms > 1.0, "a tilt stays in the RMS");
}

#[test]
fn pv_is_the_largest_minus_the_smallest() {
    let s = statistics::statistics(ndarray::array![[-1.0, f64::NAN], [0.5, 4.0]].view()).unwrap();
    assert_eq!(s.pv, 5.0);
}

// ---------------------------------------------------------------------------------------------
// Tool

#[test]
fn tif_is_the_rate_at_pixel_minus_tool() {
    // The tool removes 0.75 mm to the right of and 0.5 mm below itself, and nowhere else.
    let tif = one_sample(2, 7);
    assert_eq!(tif.rate_at(0.75, -0.5), 1.0);
    assert_eq!(tif.rate_at(-0.75, 0.5), 0.0);
    let (r, c) = (14, 20);
    let tool = [part().x.coordinate_mm(c), part().y.coordinate_mm(r)];
    let map = removal(&standing(tool, 1.0), &tif, &flat(part()));
    // A convolution: the TIF is laid on the part as it is drawn, neither turned nor mirrored.
    assert_eq!(peak(map.removal_nm()), (r - 2, c + 3));
    near(map.removal_nm()[[r - 2, c + 3]], 1.0, FFT_ROUNDING);
}

#[test]
fn tif_is_zero_beyond_its_samples() {
    let g = grid((-1.0, 0.25, 9), (-1.0, 0.25, 9));
    let tif = Tif::new(g, Array2::ones(g.shape())).unwrap();
    assert_eq!(
        [tif.rate_at(1.0, -1.0), tif.rate_at(1.0001, 0.0), tif.rate_at(0.0, -1.01)],
        [1.0, 0.0, 0.0]
    );
    let tool = [part().x.coordinate_mm(20), part().y.coordinate_mm(14)];
    let map = removal(&standing(tool, 1.0), &tif, &flat(part()));
    near(map.removal_nm()[[14, 24]], 1.0, FFT_ROUNDING);
    near(map.removal_nm()[[14, 25]], 0.0, FFT_ROUNDING);
}

#[test]
fn tif_is_cubic_between_its_samples() {
    // Keys' cubic convolution reproduces quadratics, also in the cells at the border.
    let g = grid((-1.0, 0.25, 9), (-1.0, 0.25, 9));
    let rate = |x: f64, y: f64| 5.0 + x - 2.0 * y + x * x + x * y;
    let samples =
        Array2::from_shape_fn(g.shape(), |(r, c)| rate(g.x.coordinate_mm(c), g.y.coordinate_mm(r)));
    let tif = Tif::new(g, samples).unwrap();
    for (x, y) in [(0.1, 0.2), (-0.97, 0.99), (0.83, -0.6)] {
        // Rounding of 10 nm/s.
        near(tif.rate_at(x, y), rate(x, y), 1e-13);
    }
}

#[test]
fn tool_off_removes_nothing() {
    let c = [[14.0, 1.0, 0.0, 0.0], [-2.0, 0.0, 0.0, 0.0]];
    let t = |on: bool| Trajectory::new(vec![0.0, 1.0], vec![c], vec![on], vec![Some(0)]).unwrap();
    let total = |t: &Trajectory| removal(t, &gaussian(), &flat(part())).removal_nm().sum();
    assert_eq!(total(&t(false)), 0.0);
    assert!(total(&t(true)) > 1.0);
}

// ---------------------------------------------------------------------------------------------
// Path and motion

#[test]
fn n_dwell_points_lie_between_n_plus_1_control_points() {
    let path = straight(&[1.0, 2.0, 4.0], 0.0);
    assert_eq!((path.len(), path.point_mm().len(), path.dwell_point_mm().len()), (2, 3, 2));
    let of = |points: usize| {
        ToolPath::new(vec![[0.0; 2]; points], vec![[0.0; 2]; 2], vec![true; 2], vec![0; 2])
    };
    assert!(of(3).is_ok() && of(2).is_err() && of(4).is_err());
}

#[test]
fn dwell_time_is_per_segment() {
    let path = straight(&[0.0, 1.0, 3.0, 4.0], 0.0);
    let dwell = DwellTime::new(vec![1.0, 2.0, 1.5]).unwrap();
    assert_eq!(dwell.total_s(), 4.5);
    let settings = pvt::PvtSettings::new(pvt::Mode::Smooth);
    let t = pvt::schedule(&path, &dwell, &ion_beam(), &settings).unwrap().trajectory;
    assert_eq!(t.break_time_s(), [0.0, 1.0, 3.0, 4.5]);
    let short = DwellTime::new(vec![1.0, 2.0]).unwrap();
    assert!(pvt::schedule(&path, &short, &ion_beam(), &settings).is_err());
}

#[test]
fn motion_is_cubic_in_segment_local_time() {
    let c = [[1.0, 2.0, 3.0, 4.0], [5.0, 0.0, 0.0, 0.0]];
    let t = Trajectory::new(
        vec![500.0, 501.0, 503.0],
        vec![c; 2],
        vec![true; 2],
        vec![Some(0), Some(1)],
    );
    let t = t.unwrap();
    // c0 + c1 u + c2 u^2 + c3 u^3, u from the start of each segment.
    for i in 0..2 {
        assert_eq!(t.segment(i).position_mm(0.0), [1.0, 5.0]);
        assert_eq!(t.segment(i).position_mm(0.5), [1.0 + 1.0 + 0.75 + 0.5, 5.0]);
    }
    assert_eq!((t.segment(1).start_s, t.segment(1).duration_s), (501.0, 2.0));
    assert_eq!(t.total_time_s(), 3.0);
}

#[test]
fn a_jump_can_be_stored_and_is_found() {
    let c = |x: f64| [[x, 0.0, 0.0, 0.0], [0.0; 4]];
    let t = Trajectory::new(
        vec![0.0, 1.0, 2.0],
        vec![c(0.0), c(-3.0)],
        vec![true; 2],
        vec![Some(0), Some(1)],
    );
    let verdict = judge(&t.unwrap(), &ion_beam());
    assert_eq!(verdict.max_position_step_mm, [3.0, 0.0]);
    assert!(!verdict.limits_respected);
}

#[test]
fn the_machine_rests_before_and_after() {
    // Uniform motion at 2 mm/s: velocity steps of 2 mm/s at both ends.
    let c = [[0.0, 2.0, 0.0, 0.0], [0.0; 4]];
    let t = Trajectory::new(vec![0.0, 1.0], vec![c], vec![true], vec![Some(0)]).unwrap();
    let x = &judge(&t, &ion_beam()).axes[0].velocity_step_mm_per_s;
    assert_eq!((x.max.value, x.min.value, x.exceeding_count), (2.0, -2.0, 2));
}

#[test]
fn limits_are_magnitudes_per_axis() {
    // x at -3 mm/s from rest to rest: beyond a limit of 2 on x, within a limit of 2 on y.
    let along = |axis: usize| {
        let mut c = [[0.0; 4]; 2];
        c[axis] = [0.0, 0.0, -6.0, 4.0]; // -2 mm in 1 s, at most 3 mm/s, 12 mm/s^2
        Trajectory::new(vec![0.0, 1.0], vec![c], vec![true], vec![Some(0)]).unwrap()
    };
    let limits = machine([2.0, 4.0], [20.0, 20.0]);
    let (x, y) = (judge(&along(0), &limits), judge(&along(1), &limits));
    assert_eq!((x.max_velocity_mm_per_s, x.limits_respected), ([3.0, 0.0], false));
    assert_eq!((y.max_velocity_mm_per_s, y.limits_respected), ([0.0, 3.0], true));
    let mut reordered = MachineFile::from(&limits);
    reordered.axes.reverse();
    assert!(reordered.checked().is_err(), "the axes are x, then y");
}
