//! Text with one pixel per line: Zygo's `.xyz`, and any lines `x y z`.
//!
//! A `Zygo XYZ Data File` has a header of 14 lines, then `#`, then `column row z` or
//! `column row No Data`, then `#`. The pitch is in the header, in m. The unit of z is not in the file:
//! micrometres by custom. Row 0 is the top. Some writers count the pixels within the camera, others within the
//! rectangle of the map whose origin is in the header; all indices of a file together tell which. A pixel
//! that is named twice is refused.
//!
//! A `Zygo ASCII Data File` has the same header, then `#`, the intensity, `#`, the phase, `#`, both as
//! whole numbers, row by row. The phase is coded as in a MetroPro file ([`super::metropro`]):
//!
//! ```text
//! height (m) = raw W S O / R
//! ```
//!
//! Other text: a line of names may come first, such as `x (mm), y (mm), z (nm)`, whose units count; so do comments such as
//! `# x[mm] y[mm] z[um]` and `# mm mm nm` (`crate::beside`). Then three numbers
//! per line, in any order of the pixels, on a uniform grid; a pixel that
//! no line names is invalid. Of more columns, those of x and y are known by their names, and that of the values if only one
//! more is there beside numbers of points; `xyz_columns` names others. Points that lie on no grid are gridded where `grid_mm`
//! asks for it (`crate::scattered`).
//!
//! Coordinates that were rounded lie on a grid if each is within one step of its last digit from its place.

use ndarray::Array2;
use planish_types::{Invalid, text::significant};
use serde_json::json;

use crate::{
    Format, Unit,
    beside::Beside,
    budget::{BYTES_PER_POINT, MOST_PIXELS, check_room, check_size, most_of},
    reading::{Coordinates, FirstRow, Pick, Reading, Window},
    scattered::{Gridded, grid},
    text,
};

const NAME: &str = "XYZ file";

/// Smallest stored phase that marks an invalid pixel, as in a MetroPro file.
const INVALID: f64 = 2_147_483_640.0;

/// Largest distance of a coordinate from the uniform grid, relative to its step; a file with a larger one
/// is refused. Larger: accepts points that are scattered, and moves them to the grid. Smaller: refuses
/// coordinates that were rounded.
const UNIFORMITY: f64 = 0.01;

/// Largest distance of a rounded coordinate from the uniform grid, in units of its last digit. Larger: accepts points that
/// are scattered. Smaller: refuses rounded coordinates. Derived: half a unit by rounding, and as much again for the step,
/// which is itself that of rounded numbers.
const ROUNDING: f64 = 1.0;

/// Largest unit of the last digit, relative to the pitch, of coordinates that may be rounded ones of a grid. Larger:
/// whole numbers in any order lie on a grid. Smaller: refuses pitches of few digits.
const MOST_ROUNDED: f64 = 0.4;

/// Reads a map from a Zygo text file, or from lines `x y z`.
///
/// # Errors
/// Refuses damaged files, and pixels that are named twice. Refuses points on no uniform grid unless `grid_mm` is given,
/// `grid_mm` for a Zygo file, and columns that are absent or leave a choice.
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

/// Kind of the content of a Zygo text file after its header.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Body {
    /// Lines `column row z`, one per pixel.
    Points,
    /// Coded phase of all pixels, row by row.
    Phase,
}

/// Header of a Zygo text file, as its lines.
struct ZygoHeader<'a>(Vec<&'a str>);

impl ZygoHeader<'_> {
    /// Returns the number in a field of a line of the header, both counted from 1. Refuses an absent field, and text
    /// that is no number.
    fn number(&self, line: usize, field: usize) -> Result<f64, Invalid> {
        let text = self.0.get(line - 1).and_then(|l| l.split_whitespace().nth(field - 1));
        let text = text.ok_or_else(|| broken(format!("has no field {field} in line {line}")))?;
        text::number(NAME, text, line, field)
    }

    /// Returns the number of pixels in a field of line 4 of the header; `field` counts from 1. Refuses a number that is
    /// negative, not whole, or 1e9 and more.
    fn pixels(&self, field: usize) -> Result<usize, Invalid> {
        match self.number(4, field)? {
            v if (0.0..1e9).contains(&v) && v.fract() == 0.0 => Ok(v as usize),
            v => Err(broken(format!("has {v} pixels in line 4, field {field}"))),
        }
    }
}

/// Reads a Zygo text file, with the content that `body` names after its header. Refuses damaged files, and factors of
/// the phase that are not positive.
fn zygo(text: &str, body: Body) -> Result<Reading, Invalid> {
    let mut all = text.lines().enumerate();
    let mut header = ZygoHeader(Vec::new());
    for (_, line) in all.by_ref() {
        if line.trim() == "#" {
            break;
        }
        header.0.push(line);
        if header.0.len() > 40 {
            return Err(broken("has no line # after its header".into()));
        }
    }
    let columns = header.pixels(3)?;
    let rows = header.pixels(4)?;
    if rows.checked_mul(columns).is_none_or(|n| n > text.len()) {
        let bytes = text.len();
        return Err(broken(format!("is truncated: {rows} x {columns} pixels, {bytes} bytes")));
    }
    check_size("phase", rows, columns)?;
    let [x0, y0] = [header.number(4, 1)?, header.number(4, 2)?];
    let scale = header.number(8, 2)?;
    let wavelength_m = header.number(8, 3)?;
    let pitch_m = header.number(8, 7)?;
    if !(pitch_m.is_finite() && pitch_m >= 0.0) {
        return Err(broken(format!("has the pixel size {pitch_m} m in line 8")));
    }

    let frame = Frame { rows, columns, x0, y0 };
    let (values, unit, factor) = match body {
        Body::Points => (frame.points(all)?, Unit::named("um"), 1.0),
        Body::Phase => {
            let obliquity = header.number(8, 5)?;
            let resolution = match header.number(11, 1)? {
                0.0 => 4096.0,
                1.0 => 32768.0,
                2.0 => 131_072.0,
                other => {
                    return Err(broken(format!("has the phase resolution {other}, not 0, 1, 2")));
                }
            };
            let factors = [wavelength_m, scale, obliquity];
            if !factors.iter().all(|f| f.is_finite() && *f > 0.0) {
                let problem = format!("has wavelength, scale factor, obliquity {factors:?}");
                return Err(broken(problem));
            }
            // z = raw W S O / R
            let factor = wavelength_m * scale * obliquity / resolution;
            (frame.phase(all)?, Unit::named("m"), factor)
        }
    };
    let mut reading = Reading::new(Format::Xyz, values, FirstRow::Top);
    reading.unit = Some(unit);
    reading.unit_by_custom = body == Body::Points;
    reading.factor = factor;
    if body == Body::Phase {
        reading.scale_applied = Some(scale);
    }
    if wavelength_m > 0.0 && wavelength_m.is_finite() {
        reading.wavelength_nm = Some(wavelength_m * 1e9);
    }
    if pitch_m > 0.0 {
        reading.pixel_mm = Some([pitch_m * 1e3; 2]);
    }
    if x0.is_finite() && y0.is_finite() {
        // TextPoint 9 begins with the size of the camera.
        let camera_rows = header.number(9, 2).ok().filter(|n| *n >= y0 + rows as f64);
        reading.window = Some(Window { first: [x0, y0], in_mm: false, frame_rows: camera_rows });
    }
    reading.stated = json!({
        "interferometric_scale_factor": scale,
        "wavelength_nm": reading.wavelength_nm,
        "origin_pixel": [x0, y0],
    });
    Ok(reading)
}

/// Rectangle of the map within the camera: its size, and its first column `x0` and row `y0`.
struct Frame {
    rows: usize,
    columns: usize,
    x0: f64,
    y0: f64,
}

impl Frame {
    /// Reads lines `column row z` up to a line `#`. Returns the heights (rows, columns), NaN at invalid pixels. Refuses
    /// too few or too many lines, pixels outside of the map, and a pixel that is named twice.
    fn points<'a>(
        &self,
        lines: impl Iterator<Item = (usize, &'a str)>,
    ) -> Result<Array2<f64>, Invalid> {
        let Self { rows, columns, .. } = *self;
        let pixels = rows * columns;
        // Place [column, row], z, line.
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
            if points.len() == pixels {
                return Err(broken(format!("has more than {pixels} pixels in line {}", i + 1)));
            }
            let (column, rest) = next(line);
            let (row, z) = next(rest);
            let place = [text::number(NAME, column, i + 1, 1)?, text::number(NAME, row, i + 1, 2)?];
            if place.iter().any(|v| v.fract() != 0.0) {
                return Err(broken(format!("has pixel {column} {row} in line {}", i + 1)));
            }
            points.push((place, text::number(NAME, z.trim(), i + 1, 3)?, i + 1));
        }
        if !closed || points.len() != pixels {
            let count = points.len();
            return Err(broken(format!(
                "is truncated: {count} of {pixels} pixels, closing # {closed}"
            )));
        }
        // Counted within the camera, or within the rectangle: one of them, for all pixels.
        let camera = [self.x0, self.y0];
        let origin = if points.iter().all(|point| self.holds(camera, point.0)) {
            camera
        } else if let Some((place, _, line)) =
            points.iter().find(|point| !self.holds([0.0; 2], point.0))
        {
            // One that lies in neither rectangle, or in one of them while another lies in the other.
            return Err(broken(format!(
                "has pixel {} {} in line {line}: the pixels lie neither all from {} {} on nor all from 0 0 on, in a \
                 map of {columns} x {rows}",
                place[0], place[1], self.x0, self.y0
            )));
        } else {
            [0.0; 2]
        };
        let mut values = Array2::from_elem((rows, columns), f64::NAN);
        let mut seen = Array2::from_elem((rows, columns), false);
        for ([column, row], z, line) in &points {
            let place = [(row - origin[1]) as usize, (column - origin[0]) as usize];
            if std::mem::replace(&mut seen[place], true) {
                let problem =
                    format!("names the pixel {column} {row} a second time in line {line}");
                return Err(Invalid::whole(NAME, problem, "give every pixel once"));
            }
            values[place] = *z;
        }
        Ok(values)
    }

    /// Returns true if the pixel `place` [column, row] lies in the rectangle of the map, if the rectangle begins at
    /// `origin` [column, row].
    fn holds(&self, origin: [f64; 2], place: [f64; 2]) -> bool {
        let size = [self.columns as f64, self.rows as f64];
        (0..2).all(|k| (0.0..size[k]).contains(&(place[k] - origin[k])))
    }

    /// Reads the coded phase between the second and the third `#`, after the header and the intensity. Returns it as
    /// stored (rows, columns), NaN at invalid pixels. Refuses another number of values than pixels.
    fn phase<'a>(
        &self,
        mut lines: impl Iterator<Item = (usize, &'a str)>,
    ) -> Result<Array2<f64>, Invalid> {
        let pixels = self.rows * self.columns;
        let mut values = Vec::new();
        lines.by_ref().find(|(_, line)| line.trim() == "#");
        for (i, line) in lines.take_while(|(_, line)| line.trim() != "#") {
            for (k, field) in line.split_whitespace().enumerate() {
                let v = text::number(NAME, field, i + 1, k + 1)?;
                values.push(if v >= INVALID { f64::NAN } else { v });
            }
            if values.len() > pixels {
                return Err(broken(format!("has more than {pixels} pixels in line {}", i + 1)));
            }
        }
        let count = values.len();
        Array2::from_shape_vec((self.rows, self.columns), values)
            .map_err(|_| broken(format!("is truncated: {count} of {pixels} pixels")))
    }
}

/// Returns the message about a damaged Zygo file.
fn broken(problem: String) -> Invalid {
    Invalid::whole(NAME, problem, "export it again from the instrument")
}

/// Splits a line into its first word and the rest.
fn next(line: &str) -> (&str, &str) {
    line.trim_start().split_once(char::is_whitespace).unwrap_or((line.trim_start(), ""))
}

/// Columns of lines `x y z`: which columns of the text they are, and their units.
#[derive(Default)]
struct Names {
    /// Unit of x and y; `None` if the names do not state it.
    coordinate_unit: Option<Unit>,
    /// Unit of z; `None` if the names do not state it.
    unit: Option<Unit>,
    /// Indices of x, y and z among the fields of a line; `None` if a line has just x, y and z in this order.
    columns: Option<[usize; 3]>,
    warnings: Vec<String>,
}

/// Largest number of columns that are looked at for their names. Larger: more memory for a long line. Smaller: columns
/// further to the right are not found.
const MOST_COLUMNS: usize = 1000;

/// Names of columns that hold the number of the point.
const NUMBERS: [&str; 16] = [
    "point", "points", "no", "no.", "nr", "nr.", "number", "#", "index", "idx", "id", "site",
    "die", "punkt", "i", "n",
];

/// Returns the names of the columns for a remedy: at most twelve, of 30 characters each.
fn listed(names: &[&str]) -> String {
    let short: Vec<String> = names
        .iter()
        .take(12)
        .map(|name| name.chars().filter(|c| !c.is_control()).take(30).collect())
        .collect();
    short.join(", ")
}

impl Names {
    /// Reads the names of the columns in line `number`, such as `x (mm),y (mm),z (nm)` or `x_mm y_mm z_um`. `requested`
    /// are the columns that the user names. Refuses columns that are absent or leave a choice, and different units of x
    /// and y.
    fn read(line: &str, number: usize, requested: Option<&[String; 3]>) -> Result<Self, Invalid> {
        // Where blanks separate the names, a bracket belongs to the word before it.
        let joined = if line.contains([',', ';', '\t']) {
            line.to_string()
        } else {
            line.replace(" (", "(").replace(" [", "[")
        };
        let fields: Vec<&str> = text::fields(&joined).take(MOST_COLUMNS).collect();
        let names = fields.iter().map(|field| Unit::of_name(field));
        let names: Vec<(String, Option<Unit>)> = names.collect::<Result<_, _>>()?;
        let short: String = line.chars().filter(|c| !c.is_control()).take(60).collect();
        let columns = match requested {
            Some(requested) => columns_of(requested, &fields, &names)?,
            None => usual_columns(&fields, &names, number, &short)?,
        };
        let [x, y, z] = columns.map(|k| names.get(k).and_then(|name| name.1));
        if let (Some(x), Some(y)) = (x, y)
            && x != y
        {
            let problem = format!("has x in {x} and y in {y} in line {number}");
            return Err(Invalid::whole(NAME, problem, "give both the same unit"));
        }
        let mut warnings = vec![format!("line {number} has the names of the columns: \"{short}\"")];
        if fields.len() > 3 {
            warnings.push(format!(
                "of these are read as x, y and z: {}",
                listed(&columns.map(|k| fields[k]))
            ));
        }
        let is_plain = fields.len() <= 3 && columns == [0, 1, 2];
        let columns = if is_plain { None } else { Some(columns) };
        Ok(Self { coordinate_unit: x.or(y), unit: z, columns, warnings })
    }

    /// Reads a second header line with the units of the columns. Returns false, and changes nothing, if it does not
    /// give x and y the same unit and z one, or if the unit of z is known.
    fn add_units(&mut self, line: &str) -> bool {
        let words = text::fields(line)
            .take(MOST_COLUMNS)
            .map(|word| word.trim_matches(['(', ')', '[', ']']));
        let units: Vec<(&str, Option<Unit>)> =
            words.map(|word| (word, Unit::spelled(word))).collect();
        let [x, y, z] =
            self.columns.unwrap_or([0, 1, 2]).map(|k| units.get(k).and_then(|unit| unit.1));
        if x.is_none() || x != y || z.is_none() || self.unit.is_some() {
            return false;
        }
        self.coordinate_unit = x;
        self.unit = z;
        true
    }
}

/// Returns the indices of the columns that the user requests, by their names with or without the unit, or by numbers
/// from 1. Refuses a column that the file does not have.
fn columns_of(
    requested: &[String; 3],
    fields: &[&str],
    names: &[(String, Option<Unit>)],
) -> Result<[usize; 3], Invalid> {
    let mut places = [0; 3];
    for (place, wanted) in places.iter_mut().zip(requested) {
        let wanted_place = match wanted.trim().parse::<usize>() {
            Ok(number) => number.checked_sub(1).filter(|k| *k < fields.len()),
            Err(_) => (0..fields.len()).find(|k| {
                let spellings = [fields[*k], &names[*k].0];
                spellings.iter().any(|name| name.trim().eq_ignore_ascii_case(wanted.trim()))
            }),
        };
        *place = wanted_place.ok_or_else(|| {
            let problem = format!("\"{wanted}\" is no column of the file");
            let remedy =
                format!("give three of these, or their numbers from 1: {}", listed(fields));
            Invalid::whole("columns", problem, remedy)
        })?;
    }
    Ok(places)
}

/// Returns the indices of x, y and z by the usual names of columns. `number` and `short` are the number and the
/// beginning of the line of names, for the message. Refuses names that leave a choice or another order.
fn usual_columns(
    fields: &[&str],
    names: &[(String, Option<Unit>)],
    number: usize,
    short: &str,
) -> Result<[usize; 3], Invalid> {
    let firsts: Vec<String> = names.iter().map(|name| first_word(&name.0)).collect();
    let count = fields.len();
    let [xs, ys] = ["x", "y"]
        .map(|axis| (0..count).filter(|k| is_axis(&firsts[*k], axis)).collect::<Vec<usize>>());
    let columns = match (&xs[..], &ys[..], count) {
        ([x], [y], 3..) => {
            let others = (0..count).filter(|k| {
                k != x
                    && k != y
                    && !NUMBERS.contains(&firsts[*k].as_str())
                    && !fields[*k].is_empty()
            });
            match others.collect::<Vec<usize>>()[..] {
                [z] if count == 3 && [*x, *y, z] != [0, 1, 2] => None,
                [z] => Some([*x, *y, z]),
                _ => None,
            }
        }
        (_, _, 3) => {
            let letters: Vec<char> = fields
                .iter()
                .filter_map(|name| name.to_lowercase().chars().find(|c| c.is_alphabetic()))
                .collect();
            match letters[..] {
                ['x', 'y', _, ..] => Some([0, 1, 2]),
                [a, b, ..] if "xyz".contains(a) && "xyz".contains(b) => None,
                _ => Some([0, 1, 2]),
            }
        }
        (_, _, 4..) => None,
        _ => Some([0, 1, 2]),
    };
    columns.ok_or_else(|| {
        let order = if count == 3 { "the columns in the order x y z, or " } else { "" };
        let listed = listed(fields);
        let remedy = format!(
            "give {order}`xyz_columns` with the names or the numbers of x, y and the values, of: {listed}"
        );
        let problem = format!("names its columns \"{short}\" in line {number}");
        Invalid::whole(NAME, problem, remedy)
    })
}

/// Returns the first word of a column's name, in lower case.
fn first_word(name: &str) -> String {
    let name = name.to_lowercase();
    let word = name.split([' ', '_', '-']).find(|word| !word.is_empty());
    word.unwrap_or_default().to_string()
}

/// Returns true if `word` is the name of a coordinate of `axis` (`x` or `y`), such as `x`, `xpos` or `x(mm)`.
fn is_axis(word: &str, axis: &str) -> bool {
    word.strip_prefix(axis).is_some_and(|rest| {
        rest.is_empty() || rest.starts_with("pos") || rest.starts_with(['(', '[', '/'])
    })
}

/// Returns the indices of the columns that the user requests by numbers from 1, in a file without names. `count` is the
/// number of columns. Refuses other text and numbers.
fn numbered_columns(requested: &[String; 3], count: usize) -> Result<[usize; 3], Invalid> {
    let mut places = [0; 3];
    for (place, wanted) in places.iter_mut().zip(requested) {
        let number = wanted.trim().parse::<usize>().ok();
        *place = number.and_then(|n| n.checked_sub(1)).filter(|k| *k < count).ok_or_else(|| {
            let problem =
                format!("\"{wanted}\" is no column of a file without names, of {count} columns");
            Invalid::whole("columns", problem, "give the numbers of x, y and the values, from 1")
        })?;
    }
    Ok(places)
}

/// Returns the number in a field, and the unit of its last digit: 0.01 for `1.25`. A zero has the unit 0. Refuses text
/// that is no number; `line` and `column` are for the message.
fn with_last_digit(field: &str, line: usize, column: usize) -> Result<(f64, f64), Invalid> {
    let value = text::number(NAME, field, line, column)?;
    let (mantissa, exponent) = field.split_once(['e', 'E']).unwrap_or((field, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    let decimals = mantissa.split_once('.').map_or(0, |(_, digits)| digits.len().min(300) as i32);
    // The last digit of a 0 says nothing of the others.
    let digit = if value == 0.0 { 0.0 } else { 10f64.powi(exponent.saturating_sub(decimals)) };
    Ok((value, digit))
}

/// A point of a text file: its coordinates [x, y] (`place`), the units of their last digits, and its value z.
struct TextPoint {
    place: [f64; 2],
    digits: [f64; 2],
    z: f64,
}

/// Reads a map from lines `x y z`, on their own grid or on the one that `pick` requests. Refuses lines that lack a
/// number, coordinates that are not finite, and what the grid refuses.
fn lines(text: &str, pick: &Pick) -> Result<Reading, Invalid> {
    let with_points = text::with_points(NAME, text)?;
    let text = with_points.as_deref().unwrap_or(text);
    let mut names = Names::default();
    let mut beside = Beside::default();
    let mut points: Vec<TextPoint> = Vec::new();
    let most = most_of(BYTES_PER_POINT);
    for (i, line) in text.lines().enumerate() {
        let trimmed = line.trim();
        if trimmed.is_empty() {
            continue;
        }
        if text::is_comment(trimmed) {
            beside.add_comment(trimmed.trim_start_matches(['#', '%']), i + 1)?;
            continue;
        }
        if points.is_empty() && names.warnings.is_empty() && text::is_names(trimmed) {
            names = Names::read(trimmed, i + 1, pick.columns.as_ref())?;
            continue;
        }
        if points.is_empty() && text::is_names(trimmed) && names.add_units(trimmed) {
            continue;
        }
        if points.len() >= most {
            check_room(NAME, points.len(), BYTES_PER_POINT)?;
        }
        if let (Some(requested), None) = (&pick.columns, names.columns)
            && names.warnings.is_empty()
        {
            names.columns = Some(numbered_columns(requested, text::fields(trimmed).count())?);
        }
        let [x, y, z] = match names.columns {
            Some(columns) => chosen_fields(trimmed, columns, i + 1)?,
            None => three_fields(trimmed, i + 1)?,
        };
        let (x, x_digit) = with_last_digit(x, i + 1, 1)?;
        let (y, y_digit) = with_last_digit(y, i + 1, 2)?;
        let z = text::number(NAME, z, i + 1, 3)?;
        if !(x.is_finite() && y.is_finite()) {
            let problem = format!("has the coordinates {x}, {y} in line {}", i + 1);
            return Err(Invalid::whole(NAME, problem, "leave out pixels without a place"));
        }
        points.push(TextPoint { place: [x, y], digits: [x_digit, y_digit], z });
    }
    if with_points.is_some() {
        names.warnings.push(text::DECIMAL_COMMAS.into());
    }
    let stated = match (names.coordinate_unit, beside.coordinate_unit) {
        (Some(a), Some(b)) if a != b => {
            let problem = format!("is {a} in the names of the columns, {b} in a comment");
            return Err(Invalid::whole(
                "coordinate_unit",
                problem,
                "correct the one that is wrong",
            ));
        }
        (a, b) => a.or(b),
    };
    if let Some(unit) = names.unit {
        beside.state_unit(unit)?;
    }
    let mut reading = on_grid(points, pick, stated)?;
    reading.warnings.extend(names.warnings);
    beside.apply(&mut reading)?;
    Ok(reading)
}

/// Returns the three fields of a line; `No Data` counts as one. Refuses another number of fields; `number` is that of
/// the line, for the message.
fn three_fields(line: &str, number: usize) -> Result<[&str; 3], Invalid> {
    let mut fields = text::fields(line);
    // "No Data" is two words.
    match [(); 5].map(|()| fields.next()) {
        [Some(x), Some(y), Some(z), None, _] => Ok([x, y, z]),
        [Some(x), Some(y), Some(no), Some(data), None]
            if no.eq_ignore_ascii_case("no") && data.eq_ignore_ascii_case("data") =>
        {
            Ok([x, y, "no data"])
        }
        _ => {
            let count = text::fields(line).count();
            let problem = format!("has {count} fields in line {number}, not x y z");
            let remedy = if count > 3 {
                "give `xyz_columns` with the numbers of x, y and the values, such as 2,3,4, or `format` csv for \
                 a matrix"
            } else {
                "give three numbers per line, or `format` csv for a matrix"
            };
            Err(Invalid::whole(NAME, problem, remedy))
        }
    }
}

/// Returns the fields of a line at the indices of x, y and z. Refuses a line with too few fields; `number` is that of
/// the line, for the message.
fn chosen_fields(line: &str, columns: [usize; 3], number: usize) -> Result<[&str; 3], Invalid> {
    let needed = columns.iter().max().map_or(0, |k| k + 1);
    let fields: Vec<&str> = text::fields(line).take(needed).collect();
    match columns.map(|k| fields.get(k).copied()) {
        [Some(x), Some(y), Some(z)] => Ok([x, y, z]),
        _ => {
            let problem = format!("has {} fields in line {number}", fields.len());
            Err(Invalid::whole(NAME, problem, format!("give at least {needed} in every line")))
        }
    }
}

/// Interpolates scattered points to a map on a grid with the pitch `pixel_mm` [x, y]. `stated` is the unit of the
/// coordinates in the file; the unit in `pick` has priority. Refuses points whose unit nobody states.
fn interpolated(
    points: &[TextPoint],
    pixel_mm: [f64; 2],
    pick: &Pick,
    stated: Option<Unit>,
) -> Result<Reading, Invalid> {
    let Some(unit) = pick.coordinate_unit.or(stated) else {
        let remedy = "give `coordinate_unit`";
        return Err(Invalid::whole("coordinate_unit", "is not in the file", remedy));
    };
    let mm = unit.mm()?;
    let points: Vec<[f64; 3]> =
        points.iter().map(|p| [p.place[0] * mm, p.place[1] * mm, p.z]).collect();
    let Gridded { values, x_mm, y_mm, warnings } = grid(&points, pixel_mm)?;
    let mut reading = Reading::new(Format::Xyz, values, FirstRow::SmallestY);
    let [x, y] = [x_mm, y_mm].map(|all| all.into_iter().map(|v| v / mm).collect());
    reading.coordinates = Some(Coordinates { x, y, unit: stated });
    reading.warnings = warnings;
    reading.stated = json!({ "points": points.len(), "grid_mm": pixel_mm });
    Ok(reading)
}

/// Returns the map of points on their own grid, or interpolated if `pick` requests a grid. `stated` is the unit of the
/// coordinates in the file. Refuses points on no grid, two points on a pixel, and a grid with points on less than 1 %
/// of its pixels.
fn on_grid(points: Vec<TextPoint>, pick: &Pick, stated: Option<Unit>) -> Result<Reading, Invalid> {
    if let Some(pixel_mm) = pick.grid_mm {
        return interpolated(&points, pixel_mm, pick, stated);
    }
    let x = uniform("x", points.iter().map(|p| (p.place[0], p.digits[0])).collect())?;
    let y = uniform("y", points.iter().map(|p| (p.place[1], p.digits[1])).collect())?;
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
        let pixel = [y.index(point.place[1]), x.index(point.place[0])];
        if std::mem::replace(&mut seen[pixel], true) {
            let [x, y] = point.place;
            let problem = format!("names the pixel x {x}, y {y} twice");
            return Err(Invalid::whole(NAME, problem, "give every pixel once"));
        }
        values[pixel] = point.z;
    }
    let mut reading = Reading::new(Format::Xyz, values, FirstRow::SmallestY);
    for (name, axis) in [("x", &x), ("y", &y)] {
        if let Some([least, most]) = axis.rounded_steps {
            reading.warnings.push(format!(
                "the coordinates {name} are rounded: steps of {} to {} are read as a pitch of {}",
                significant(least, 6),
                significant(most, 6),
                significant(axis.step, 6)
            ));
        }
    }
    reading.coordinates = Some(Coordinates { x: x.all(), y: y.all(), unit: stated });
    Ok(reading)
}

/// A uniform axis on which the coordinates of points lie, in the unit of the file: first coordinate, pitch and number
/// of pixels.
struct UniformAxis {
    start: f64,
    step: f64,
    count: usize,
    /// Smallest and largest step between neighbouring pixels in the file, if rounding makes the steps differ; otherwise
    /// `None`.
    rounded_steps: Option<[f64; 2]>,
}

/// Returns the uniform axis of the coordinates, each a value with the unit of its last digit. The step is their
/// smallest distance, or the pitch that fits rounded coordinates. Refuses a single coordinate, and coordinates on no
/// uniform axis.
fn uniform(name: &'static str, mut coordinates: Vec<(f64, f64)>) -> Result<UniformAxis, Invalid> {
    coordinates.sort_by(|a, b| a.0.total_cmp(&b.0));
    let values: Vec<f64> = coordinates.iter().map(|c| c.0).collect();
    let (Some(start), Some(end)) = (values.first().copied(), values.last().copied()) else {
        return Err(Invalid::whole(NAME, "holds no points", "give lines x y z"));
    };
    // Coordinates of one column that were computed differently are equal to rounding.
    let apart = 1e-6 * (end - start) / (values.len() as f64).max(1.0);
    coordinates.dedup_by(|b, a| b.0 - a.0 <= apart);
    let values: Vec<f64> = coordinates.iter().map(|c| c.0).collect();
    let least = values.windows(2).map(|w| w[1] - w[0]).fold(f64::INFINITY, f64::min);
    if !(least.is_finite() && (end - start).is_finite()) {
        let problem = format!("has only the value {start}");
        return Err(Invalid::whole(name, problem, "a map has at least 2 x 2 pixels"));
    }
    let steps = ((end - start) / least).round();
    let step = (end - start) / steps;
    // A coordinate is a whole number of steps from the start.
    let is_uniform = values.iter().all(|v| {
        let i = ((v - start) / step).round();
        (v - (start + i * step)).abs() <= UNIFORMITY * step
    });
    if steps < MOST_PIXELS as f64 && is_uniform {
        return Ok(UniformAxis { start, step, count: steps as usize + 1, rounded_steps: None });
    }
    rounded(&coordinates).ok_or_else(|| jump(name, &values))
}

/// Returns the uniform axis of ascending rounded coordinates, each a value with the unit of its last digit. Returns
/// `None` for fewer than three, for last digits that are coarse beside the step, and for coordinates on no uniform
/// axis.
///
/// The least-squares line through the coordinates against the numbers of their pixels has the pitch. A pixel may be
/// absent: the numbers follow from the median step.
fn rounded(coordinates: &[(f64, f64)]) -> Option<UniformAxis> {
    let mut steps: Vec<f64> = coordinates.windows(2).map(|w| w[1].0 - w[0].0).collect();
    let all = steps.clone();
    steps.sort_by(f64::total_cmp);
    let usual = steps[steps.len() / 2];
    let digit = coordinates.iter().map(|c| c.1).fold(0.0, f64::max);
    if coordinates.len() < 3 || !(usual > 0.0 && digit <= MOST_ROUNDED * usual) {
        return None;
    }
    let mut numbers = vec![0.0];
    for step in &all {
        // Distances from neighbour to neighbour: the errors of rounding do not add up.
        numbers.push(numbers[numbers.len() - 1] + (step / usual).round().max(1.0));
    }
    let n = numbers.len() as f64;
    let mean = [numbers.iter().sum::<f64>() / n, coordinates.iter().map(|c| c.0).sum::<f64>() / n];
    let mut product = 0.0;
    let mut square = 0.0;
    for (number, (value, _)) in numbers.iter().zip(coordinates) {
        product += (number - mean[0]) * (value - mean[1]);
        square += (number - mean[0]).powi(2);
    }
    let step = product / square;
    let start = mean[1] - step * mean[0];
    let count = numbers[numbers.len() - 1];
    let is_uniform = numbers.iter().zip(coordinates).all(|(number, (value, digit))| {
        (value - (start + number * step)).abs() <= (ROUNDING * digit).max(UNIFORMITY * step)
    });
    if count >= MOST_PIXELS as f64 || !is_uniform {
        return None;
    }
    let of_one_pixel = all.iter().copied().filter(|s| (s / usual).round() <= 1.0);
    let least = of_one_pixel.clone().fold(f64::INFINITY, f64::min);
    let rounded_steps = Some([least, of_one_pixel.fold(0.0, f64::max)]);
    Some(UniformAxis { start, step, count: count as usize + 1, rounded_steps })
}

/// Returns the message about coordinates on no grid. It names the first distance of neighbours that is no multiple of
/// the usual (median) one.
fn jump(name: &'static str, values: &[f64]) -> Invalid {
    let mut steps: Vec<f64> = values.windows(2).map(|w| w[1] - w[0]).collect();
    let all = steps.clone();
    steps.sort_by(f64::total_cmp);
    let usual = steps[steps.len() / 2];
    let first = all.iter().position(|step| {
        let ratio = step / usual;
        (ratio - ratio.round()).abs() > UNIFORMITY * ratio.round().max(1.0) || ratio < 0.5
    });
    let i = first.unwrap_or(0);
    let [a, b] = [values[i], values[i + 1]];
    let problem =
        format!("has {b} after {a}: a step of {}, where the usual step is {usual}", b - a);
    Invalid::whole(name, problem, "correct the coordinate, or give `grid_mm` to interpolate")
}

impl UniformAxis {
    /// Returns the index of the pixel nearest to a coordinate, limited to the axis.
    fn index(&self, v: f64) -> usize {
        // A float to an integer saturates: a rounded first coordinate may lie before the start.
        (((v - self.start) / self.step).round() as usize).min(self.count - 1)
    }

    /// Returns the coordinates of all pixels, in the unit of the file.
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
        assert_eq!((reading.unit, reading.unit_by_custom), (Some(Unit::named("m")), false));
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
        assert_eq!((reading.unit, reading.unit_by_custom), (Some(Unit::named("um")), true));
        // 1.5e-4 m; the product rounds.
        assert!((reading.pixel_mm.unwrap()[0] - 0.15).abs() < 1e-15);
        let cut = &text[..text.len() - 8];
        assert!(
            read(cut.as_bytes(), &Pick::default()).unwrap_err().to_string().contains("truncated")
        );
    }
}
