//! Text with one pixel per line: Zygo's `.xyz`, and any lines `x y z`.
//!
//! A `Zygo XYZ Data File` has a header of 14 lines, then `#`, then `column row z` or
//! `column row No Data`, then `#`. The pitch is in the header, in m. The unit of z is not in the file:
//! micrometres by custom. Row 0 is the top. Some writers count the pixels within the camera, others within the
//! rectangle of the map whose origin is in the header; all indices of a file together tell which. A pixel
//! that is named twice is refused.
//!
//! A `Zygo ASCII Data File` has the same header, then `#`, the intensity, `#`, the phase, `#`, both as
//! whole numbers, row by row. The phase is coded as in a MetroPro file ([`crate::metropro`]):
//!
//! ```text
//! height (m) = raw W S O / R
//! ```
//!
//! Other text: a line of names may come first, such as `x (mm), y (mm), z (nm)`, whose units count. Then three numbers
//! per line, in any order of the pixels, on a uniform grid; a pixel that
//! no line names is invalid. Points that lie on no grid are gridded where `grid_mm` asks for it
//! (`crate::scattered`).

use ndarray::Array2;
use planish_types::Invalid;
use serde_json::json;

use crate::{
    Format, Unit,
    budget::{BYTES_PER_POINT, MOST_PIXELS, check_room, check_size, most_of},
    reading::{Coordinates, FirstRow, Pick, Reading},
    scattered::{Gridded, grid},
    text,
};

const NAME: &str = "XYZ file";

/// Smallest raw phase that marks an invalid pixel, as in a MetroPro file.
const INVALID: f64 = 2_147_483_640.0;

/// Largest distance of a coordinate from the uniform grid, relative to its step; a file with a larger one
/// is refused. Larger: accepts points that are scattered, and moves them to the grid. Smaller: refuses
/// coordinates that were rounded.
const UNIFORMITY: f64 = 0.01;

/// Reads a Zygo file or lines of `x y z`.
pub fn read(bytes: &[u8], pick: &Pick) -> Result<Reading, Invalid> {
    let text = text::text(NAME, bytes)?;
    let text = text.as_ref();
    if pick.grid_mm.is_some() && text.starts_with("Zygo ") {
        let problem = "was given, but the file has its pixels on a grid";
        return Err(Invalid::whole("grid_mm", problem, "leave it out"));
    }
    if text.starts_with("Zygo XYZ Data File") {
        zygo(text, Body::Points)
    } else if text.starts_with("Zygo ASCII Data File") {
        zygo(text, Body::Phase)
    } else {
        lines(text, pick)
    }
}

/// Contents of a Zygo file after its header.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Body {
    /// Lines `column row z`.
    Points,
    /// Coded phase, row by row.
    Phase,
}

fn zygo(text: &str, body: Body) -> Result<Reading, Invalid> {
    let bad =
        |problem: String| Invalid::whole(NAME, problem, "export it again from the instrument");
    let mut all = text.lines().enumerate();
    let mut header = Vec::new();
    for (_, line) in all.by_ref() {
        if line.trim() == "#" {
            break;
        }
        header.push(line);
        if header.len() > 40 {
            return Err(bad("has no line # after its header".into()));
        }
    }
    let field = |line: usize, field: usize| -> Result<f64, Invalid> {
        let text = header.get(line - 1).and_then(|l| l.split_whitespace().nth(field - 1));
        let text = text.ok_or_else(|| bad(format!("has no field {field} in line {line}")))?;
        text::number(NAME, text, line, field)
    };
    let size = |n: usize| match field(4, n)? {
        v if (0.0..1e9).contains(&v) && v.fract() == 0.0 => Ok(v as usize),
        v => Err(bad(format!("has {v} pixels in line 4, field {n}"))),
    };
    let (columns, rows) = (size(3)?, size(4)?);
    if rows.checked_mul(columns).is_none_or(|n| n > text.len()) {
        return Err(bad(format!("is truncated: {rows} x {columns} pixels, {} bytes", text.len())));
    }
    check_size("phase", rows, columns)?;
    let (x0, y0) = (field(4, 1)?, field(4, 2)?);
    let (scale, wavelength_m, pitch_m) = (field(8, 2)?, field(8, 3)?, field(8, 7)?);
    if !(pitch_m.is_finite() && pitch_m >= 0.0) {
        return Err(bad(format!("has the pixel size {pitch_m} m in line 8")));
    }

    let frame = Frame { rows, columns, x0, y0 };
    let (values, unit, factor) = match body {
        Body::Points => (frame.points(all)?, Unit::Um, 1.0),
        Body::Phase => {
            let (obliquity, resolution) = (field(8, 5)?, field(11, 1)?);
            let resolution = match resolution {
                0.0 => 4096.0,
                1.0 => 32768.0,
                2.0 => 131_072.0,
                other => return Err(bad(format!("has the phase resolution {other}, not 0, 1, 2"))),
            };
            let factors = [wavelength_m, scale, obliquity];
            if !factors.iter().all(|f| f.is_finite() && *f > 0.0) {
                let problem = format!("has wavelength, scale factor, obliquity {factors:?}");
                return Err(bad(problem));
            }
            // z = raw W S O / R
            let factor = wavelength_m * scale * obliquity / resolution;
            (frame.phase(all)?, Unit::M, factor)
        }
    };
    let mut reading = Reading::new(Format::Xyz, values, FirstRow::Top);
    (reading.unit, reading.unit_by_custom) = (Some(unit), body == Body::Points);
    reading.factor = factor;
    reading.scale_applied = (body == Body::Phase).then_some(scale);
    if wavelength_m > 0.0 && wavelength_m.is_finite() {
        reading.wavelength_nm = Some(wavelength_m * 1e9);
    }
    if pitch_m > 0.0 {
        reading.pixel_mm = Some([pitch_m * 1e3; 2]);
    }
    reading.stated = json!({
        "interferometric_scale_factor": scale,
        "wavelength_nm": reading.wavelength_nm,
        "origin_pixel": [x0, y0],
    });
    Ok(reading)
}

/// The rectangle of the pixels within the camera.
struct Frame {
    rows: usize,
    columns: usize,
    x0: f64,
    y0: f64,
}

impl Frame {
    /// Lines `column row z` up to a line `#`.
    fn points<'a>(
        &self,
        lines: impl Iterator<Item = (usize, &'a str)>,
    ) -> Result<Array2<f64>, Invalid> {
        let (rows, columns) = (self.rows, self.columns);
        let of = rows * columns;
        // Column, row, z, line.
        let mut points: Vec<([f64; 2], f64, usize)> = Vec::new();
        let mut closed = false;
        for (i, line) in lines {
            let line = line.trim();
            if line == "#" {
                closed = true;
                break;
            }
            if line.is_empty() {
                continue;
            }
            if points.len() == of {
                return Err(broken(format!("has more than {of} pixels in line {}", i + 1)));
            }
            let (column, rest) = next(line);
            let (row, z) = next(rest);
            let at = [text::number(NAME, column, i + 1, 1)?, text::number(NAME, row, i + 1, 2)?];
            if at.iter().any(|v| v.fract() != 0.0) {
                return Err(broken(format!("has pixel {column} {row} in line {}", i + 1)));
            }
            points.push((at, text::number(NAME, z.trim(), i + 1, 3)?, i + 1));
        }
        if !closed || points.len() != of {
            let count = points.len();
            return Err(broken(format!(
                "is truncated: {count} of {of} pixels, closing # {closed}"
            )));
        }
        // Counted within the camera, or within the rectangle: one of them, for all pixels.
        let size = [columns as f64, rows as f64];
        let inside = |origin: &[f64; 2], at: &[f64; 2]| {
            (0..2).all(|k| (0.0..size[k]).contains(&(at[k] - origin[k])))
        };
        let origins = [[self.x0, self.y0], [0.0; 2]];
        let fits = |origin: &&[f64; 2]| points.iter().all(|(at, ..)| inside(origin, at));
        let Some(origin) = origins.iter().find(fits) else {
            // One that lies in neither rectangle, or in one of them while another lies in the other.
            let beside = |(at, ..): &&([f64; 2], f64, usize)| !inside(&origins[1], at);
            let (at, _, line) = points.iter().find(beside).expect("they do not all fit");
            return Err(broken(format!(
                "has pixel {} {} in line {line}: the pixels lie neither all from {} {} on nor all from 0 0 on, in a \
                 map of {columns} x {rows}",
                at[0], at[1], self.x0, self.y0
            )));
        };
        let mut values = Array2::from_elem((rows, columns), f64::NAN);
        let mut seen = Array2::from_elem((rows, columns), false);
        for ([column, row], z, line) in &points {
            let at = [(row - origin[1]) as usize, (column - origin[0]) as usize];
            if std::mem::replace(&mut seen[at], true) {
                let problem =
                    format!("names the pixel {column} {row} a second time in line {line}");
                return Err(Invalid::whole(NAME, problem, "give every pixel once"));
            }
            values[at] = *z;
        }
        Ok(values)
    }

    /// The numbers between the second and the third `#` (the first one closed the header).
    fn phase<'a>(
        &self,
        mut lines: impl Iterator<Item = (usize, &'a str)>,
    ) -> Result<Array2<f64>, Invalid> {
        let of = self.rows * self.columns;
        let mut values = Vec::new();
        lines.by_ref().find(|(_, line)| line.trim() == "#");
        for (i, line) in lines.take_while(|(_, line)| line.trim() != "#") {
            for (k, field) in line.split_whitespace().enumerate() {
                let v = text::number(NAME, field, i + 1, k + 1)?;
                values.push(if v >= INVALID { f64::NAN } else { v });
            }
            if values.len() > of {
                return Err(broken(format!("has more than {of} pixels in line {}", i + 1)));
            }
        }
        let found = values.len();
        Array2::from_shape_vec((self.rows, self.columns), values)
            .map_err(|_| broken(format!("is truncated: {found} of {of} pixels")))
    }
}

fn broken(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "export it again from the instrument")
}

/// The first word, and the rest.
fn next(line: &str) -> (&str, &str) {
    line.trim_start().split_once(char::is_whitespace).unwrap_or((line.trim_start(), ""))
}

/// Units and warnings of lines `x y z`.
#[derive(Default)]
struct Names {
    /// Unit of x and y.
    coordinate_unit: Option<Unit>,
    /// Unit of z.
    unit: Option<Unit>,
    warnings: Vec<String>,
}

impl Names {
    /// The names of the columns in a line above the points, such as `x (mm),y (mm),z (nm)` or `x_mm y_mm z_um`.
    fn of(line: &str, number: usize) -> Result<Self, Invalid> {
        let names: Vec<String> = text::fields(line).map(str::to_lowercase).collect();
        let letters: Vec<char> =
            names.iter().filter_map(|name| name.chars().find(|c| c.is_alphabetic())).collect();
        let short: String = line.chars().filter(|c| !c.is_control()).take(60).collect();
        match letters[..] {
            ['x', 'y', _, ..] => {}
            [a, b, ..] if "xyz".contains(a) && "xyz".contains(b) => {
                let problem = format!("names its columns \"{short}\" in line {number}");
                return Err(Invalid::whole(NAME, problem, "give the columns in the order x y z"));
            }
            _ => {}
        }
        let unit = |name: Option<&String>| {
            let name = name?.trim_end_matches([')', ']']);
            let last = name.rsplit(['(', '[', '_', ' ', '/']).next().unwrap_or_default();
            Unit::stated("unit", last).ok()
        };
        let [x, y, z] = [0, 1, 2].map(|k| unit(names.get(k)));
        if x != y {
            let problem = format!("has x in {x:?} and y in {y:?} in line {number}");
            return Err(Invalid::whole(NAME, problem, "give both the same unit"));
        }
        let say = format!("line {number} has the names of the columns: \"{short}\"");
        Ok(Self { coordinate_unit: x, unit: z, warnings: vec![say] })
    }
}

fn lines(text: &str, pick: &Pick) -> Result<Reading, Invalid> {
    let with_points = text::with_points(NAME, text)?;
    let text = with_points.as_deref().unwrap_or(text);
    let mut names = Names::default();
    let mut points: Vec<[f64; 3]> = Vec::new();
    let most = most_of(BYTES_PER_POINT);
    for (i, line) in text.lines().enumerate() {
        let trimmed = line.trim();
        if trimmed.is_empty() || text::is_comment(trimmed) {
            continue;
        }
        if points.is_empty() && names.warnings.is_empty() && text::is_names(trimmed) {
            names = Names::of(trimmed, i + 1)?;
            continue;
        }
        if points.len() >= most {
            check_room(NAME, points.len(), BYTES_PER_POINT)?;
        }
        let mut fields = text::fields(trimmed);
        // "No Data" is two words.
        let [x, y, z] = match [(); 5].map(|()| fields.next()) {
            [Some(x), Some(y), Some(z), None, _] => [x, y, z],
            [Some(x), Some(y), Some(no), Some(data), None]
                if no.eq_ignore_ascii_case("no") && data.eq_ignore_ascii_case("data") =>
            {
                [x, y, "no data"]
            }
            _ => {
                let count = text::fields(trimmed).count();
                let problem = format!("has {count} fields in line {}, not x y z", i + 1);
                let remedy = "give three numbers per line, or `format` csv for a matrix";
                return Err(Invalid::whole(NAME, problem, remedy));
            }
        };
        let point = [
            text::number(NAME, x, i + 1, 1)?,
            text::number(NAME, y, i + 1, 2)?,
            text::number(NAME, z, i + 1, 3)?,
        ];
        if !(point[0].is_finite() && point[1].is_finite()) {
            let problem =
                format!("has the coordinates {}, {} in line {}", point[0], point[1], i + 1);
            return Err(Invalid::whole(NAME, problem, "leave out pixels without a place"));
        }
        points.push(point);
    }
    if with_points.is_some() {
        names.warnings.push(text::DECIMAL_COMMAS.into());
    }
    let mut reading = on_grid(points, pick, names.coordinate_unit)?;
    reading.unit = names.unit;
    reading.warnings.extend(names.warnings);
    Ok(reading)
}

/// The map of points on their own grid, or on the one that is asked for.
fn on_grid(
    mut points: Vec<[f64; 3]>,
    pick: &Pick,
    stated: Option<Unit>,
) -> Result<Reading, Invalid> {
    if let Some(pixel_mm) = pick.grid_mm {
        let Some(unit) = pick.coordinate_unit.or(stated) else {
            let remedy = "give `coordinate_unit`";
            return Err(Invalid::whole("coordinate_unit", "is not in the file", remedy));
        };
        let mm = unit.mm()?;
        for point in &mut points {
            (point[0], point[1]) = (point[0] * mm, point[1] * mm);
        }
        let Gridded { values, x_mm, y_mm, warnings } = grid(&points, pixel_mm)?;
        let mut reading = Reading::new(Format::Xyz, values, FirstRow::SmallestY);
        let of_file = |mm_all: Vec<f64>| mm_all.into_iter().map(|v| v / mm).collect();
        reading.coordinates =
            Some(Coordinates { x: of_file(x_mm), y: of_file(y_mm), unit: stated });
        reading.warnings = warnings;
        reading.stated = json!({ "points": points.len(), "grid_mm": pixel_mm });
        return Ok(reading);
    }
    let x = uniform("x", points.iter().map(|p| p[0]).collect())?;
    let y = uniform("y", points.iter().map(|p| p[1]).collect())?;
    check_size(NAME, y.count, x.count)?;
    // A grid of which most pixels are absent is a mistake in the coordinates.
    if x.count * y.count > 100 * points.len() {
        let problem = format!("names {} of {} x {} pixels", points.len(), y.count, x.count);
        return Err(Invalid::whole(
            NAME,
            problem,
            "correct the coordinates, or give `grid_mm` to interpolate",
        ));
    }
    let mut values = Array2::from_elem((y.count, x.count), f64::NAN);
    let mut seen = Array2::from_elem((y.count, x.count), false);
    for point in &points {
        let at = [y.index(point[1]), x.index(point[0])];
        if std::mem::replace(&mut seen[at], true) {
            let problem = format!("names the pixel x {}, y {} twice", point[0], point[1]);
            return Err(Invalid::whole(NAME, problem, "give every pixel once"));
        }
        values[at] = point[2];
    }
    let mut reading = Reading::new(Format::Xyz, values, FirstRow::SmallestY);
    reading.coordinates = Some(Coordinates { x: x.all(), y: y.all(), unit: stated });
    Ok(reading)
}

/// A uniform axis found among coordinates.
struct Found {
    start: f64,
    step: f64,
    count: usize,
}

/// The axis whose step is the least distance of the given coordinates; where that is none, the place
/// where they jump.
fn uniform(name: &'static str, mut values: Vec<f64>) -> Result<Found, Invalid> {
    values.sort_by(f64::total_cmp);
    let (Some(start), Some(end)) = (values.first().copied(), values.last().copied()) else {
        return Err(Invalid::whole(NAME, "holds no points", "give lines x y z"));
    };
    // Coordinates of one column that were computed differently are equal to rounding.
    let apart = 1e-6 * (end - start) / (values.len() as f64).max(1.0);
    values.dedup_by(|b, a| *b - *a <= apart);
    let least = values.windows(2).map(|w| w[1] - w[0]).fold(f64::INFINITY, f64::min);
    if !(least.is_finite() && (end - start).is_finite()) {
        let problem = format!("has only the value {start}");
        return Err(Invalid::whole(name, problem, "a map has at least 2 x 2 pixels"));
    }
    let steps = ((end - start) / least).round();
    let step = (end - start) / steps;
    // A coordinate is a whole number of steps from the start.
    let on_grid = |v: f64| {
        let i = ((v - start) / step).round();
        (v - (start + i * step)).abs() <= UNIFORMITY * step
    };
    if steps >= MOST_PIXELS as f64 || !values.iter().copied().all(on_grid) {
        return Err(jump(name, &values));
    }
    Ok(Found { start, step, count: steps as usize + 1 })
}

/// The first of ascending coordinates whose distance is no multiple of the usual one.
fn jump(name: &'static str, values: &[f64]) -> Invalid {
    let mut steps: Vec<f64> = values.windows(2).map(|w| w[1] - w[0]).collect();
    let at = |i: usize| [values[i], values[i + 1]];
    let all = steps.clone();
    steps.sort_by(f64::total_cmp);
    let usual = steps[steps.len() / 2];
    let off = |step: &f64| {
        let ratio = step / usual;
        (ratio - ratio.round()).abs() > UNIFORMITY * ratio.round().max(1.0) || ratio < 0.5
    };
    let i = all.iter().position(off).unwrap_or(0);
    let [a, b] = at(i);
    let problem =
        format!("has {b} after {a}: a step of {}, where the usual step is {usual}", b - a);
    Invalid::whole(name, problem, "correct the coordinate, or give `grid_mm` to interpolate")
}

impl Found {
    fn index(&self, v: f64) -> usize {
        (((v - self.start) / self.step).round() as usize).min(self.count - 1)
    }

    fn all(&self) -> Vec<f64> {
        (0..self.count).map(|i| self.start + i as f64 * self.step).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn points_in_any_order_become_a_grid_with_holes() {
        let text = "# x y z\n1.0 0 3\n0,0,1\n0.5 0 2\n0 2 4\n1 2 No Data\n";
        let reading = read(text.as_bytes(), &Pick::default()).unwrap();
        let [a, b] = [reading.values.row(0).to_vec(), reading.values.row(1).to_vec()];
        assert_eq!(a, [1.0, 2.0, 3.0]);
        assert!(b[0] == 4.0 && b[1].is_nan() && b[2].is_nan());
        let c = reading.coordinates.unwrap();
        assert_eq!((c.x, c.y), (vec![0.0, 0.5, 1.0], vec![0.0, 2.0]));
    }

    #[test]
    fn what_is_no_grid_is_refused() {
        let message = |text: &str| read(text.as_bytes(), &Pick::default()).unwrap_err().to_string();
        assert!(message("0 0 1\n1 0 2\n0 1 3\n1 1 4\n1 1 4\n").contains("twice"));
        let said = message("0 0 1\n1 0 2\n2 0 2\n0 1 3\n2.4 1 4\n");
        assert!(said.contains("x: has 2.4 after 2: a step of 0.3999"), "{said}");
        assert!(said.contains("the usual step is 1"), "{said}");
        assert!(message("0 0 1\n1 0 2\n").contains("only the value 0"));
        assert!(message("0 0 1\n1 0 x\n").contains("\"x\" in line 2, field 3"));
        assert!(message("0 0\n").contains("not x y z"));
        assert!(message("0 0 1\n400 1 1\n1e9 2 1\n").contains("names 3 of"));
        assert!(message("").contains("holds no points"));
    }

    #[test]
    fn a_zygo_file_of_coded_phase_by_hand() {
        let mut text = String::from("Zygo ASCII Data File - Format 2\n0\n0\n0 0 2 2\n\n\n\n");
        text += "0 0.5 6.4e-007 0 1 0 1.5e-004 0\n0\n0\n1 1\n0\n0\n0\n#\n7 7\n#\n";
        let whole = format!("{text}32768 -16384 2147483640\n0\n#\n");
        let reading = read(whole.as_bytes(), &Pick::default()).unwrap();
        // 32768 is half a wavelength of 640 nm.
        assert!((reading.factor * 32768.0 - 320e-9).abs() < 1e-22);
        assert_eq!(reading.values.row(0), array![32768.0, -16384.0]);
        assert!(reading.values[[1, 0]].is_nan() && reading.values[[1, 1]] == 0.0);
        assert_eq!((reading.unit, reading.unit_by_custom), (Some(Unit::M), false));
        let cut = format!("{text}32768 -16384\n#\n");
        assert!(
            read(cut.as_bytes(), &Pick::default())
                .unwrap_err()
                .to_string()
                .contains("2 of 4 pixels")
        );
    }

    #[test]
    fn a_zygo_file_by_hand() {
        let mut text = String::from("Zygo XYZ Data File - Format 1\n0 5 0 0 \"x\"\n0 0 0 0 0 0\n");
        text += "3 4 2 2\n\"\"\n\"\"\n\"\"\n0 0.5 6.328e-007 0 1 0 1.5e-004 0\n";
        text += "0\n0\n0\n0\n0\n0\n#\n3 4 0.25\n4 4 -0.5\n3 5 No Data\n4 5 1\n#\n";
        let reading = read(text.as_bytes(), &Pick::default()).unwrap();
        assert_eq!(reading.values.row(0), array![0.25, -0.5]);
        assert!(reading.values[[1, 0]].is_nan());
        assert_eq!((reading.unit, reading.unit_by_custom), (Some(Unit::Um), true));
        // 1.5e-4 m; the product rounds.
        assert!((reading.pixel_mm.unwrap()[0] - 0.15).abs() < 1e-15);
        let cut = &text[..text.len() - 8];
        assert!(
            read(cut.as_bytes(), &Pick::default()).unwrap_err().to_string().contains("truncated")
        );
    }
}
