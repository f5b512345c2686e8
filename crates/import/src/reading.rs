//! Conversion of the numbers of a file to a map in nm on a grid in mm.
//!
//! ```text
//! height (nm) = (offset + factor x stored value) x unit of the file (nm) x factor asked for
//! ```
//!
//! Without an offset this is one multiplication, so that a map comes back to the last bit its file holds. A unit or a
//! pitch that the file does not state is asked for. A setting that contradicts the file is refused with both values;
//! with [`ReadingSettings::override_file`] it takes the file's place. Settings are the statements of the user; a
//! [`Reading`] holds those of the file.

use ndarray::Array2;
use planish_types::{Axis, Grid, Invalid, Surface, Tif, text::significant};
use serde::Serialize;
use serde_json::Value;

use crate::{Format, Unit};

/// Side of the map, smallest or largest y, that the first row of a file is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum FirstRow {
    /// The largest y: the top of the picture.
    Top,
    /// The smallest y: the bottom of the picture.
    #[value(name = "bottom")]
    SmallestY,
}

/// Choice of the arrays (or columns) of a map in a file that holds several; `None` leaves the choice to the reader.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Pick {
    /// Name or path of the array that is the map.
    #[serde(rename = "data")]
    pub dataset: Option<String>,
    /// Name or path of the x coordinates, those of the columns: a vector, or a matrix as `meshgrid` makes it.
    pub x: Option<String>,
    /// Name or path of the y coordinates, those of the rows, likewise.
    pub y: Option<String>,
    /// Name or path of an array of the same size as the map, in which a number other than 0 marks an invalid pixel.
    pub mask: Option<String>,
    /// Pitch [x, y], mm, of the grid to which scattered points (lines `x y z`) are interpolated; `None` if the points
    /// lie on a grid.
    pub grid_mm: Option<[f64; 2]>,
    /// Unit of the coordinates of scattered points, which has priority over that of the file; `None` if the file states
    /// it.
    pub coordinate_unit: Option<Unit>,
    /// Columns of x, y and the values in lines of text, by name or by number, counted from 1; `None` leaves the choice
    /// to their names and order.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub columns: Option<[String; 3]>,
    /// True if the map is a tool influence function (TIF): its customary names are then tried if no name is given.
    pub is_tif: bool,
}

/// Coordinates of the columns and rows, in the unit of the file.
#[derive(Clone, Debug)]
pub struct Coordinates {
    /// Coordinates of the columns (nx); ascending or descending.
    pub x: Vec<f64>,
    /// Coordinates of the rows (ny), ascending or descending.
    pub y: Vec<f64>,
    /// Unit of the coordinates, if the file states it.
    pub unit: Option<Unit>,
}

/// Rule by which a header gives the coordinates of the pixels, for [x, y] each, in the order and in the units of the
/// file:
///
/// ```text
/// coordinate of pixel i = coordinate + step (i - pixel)
/// ```
#[derive(Clone, Debug)]
pub struct Rule {
    /// Step from a pixel to the next, not 0. The axis descends if it is negative.
    pub step: [f64; 2],
    /// Unit of step and coordinate along [x, y], if the file states it.
    pub unit: [Option<Unit>; 2],
    /// A pixel, counted from 0 in the order of the file, and its coordinate, for [x, y]; `None` if the header states
    /// steps alone.
    pub reference: Option<[(f64, f64); 2]>,
}

/// Position of the first pixel of a file in a larger frame: the camera, or the field of a scanner. Rows are counted in
/// the order of the file.
#[derive(Clone, Copy, Debug)]
pub struct Window {
    /// Column and row [x, y] of the first pixel, counted from the first of the frame; in mm if `in_mm`.
    pub first: [f64; 2],
    /// True if `first` is in mm, false if it is in pixels.
    pub in_mm: bool,
    /// Number of rows of the frame; `None` if the file does not state it.
    pub frame_rows: Option<f64>,
}

impl Window {
    /// Returns the window whose first pixel lies at `first` [x, y], mm, in a frame of unknown size.
    pub(crate) fn at_mm(first: [f64; 2]) -> Self {
        Self { first, in_mm: true, frame_rows: None }
    }

    /// Returns the smallest coordinates [x, y] of a map with `rows` rows, mm. x = 0 is the first column of the frame. y
    /// = 0 is the row of the frame with the smallest y; for a map whose first row is the top in a frame of unknown size
    /// it is the first row of the frame.
    fn start_mm(&self, pitch_mm: [f64; 2], rows: usize, first_row: FirstRow) -> [f64; 2] {
        let [x, y] = [0, 1].map(|k| self.first[k] * if self.in_mm { 1.0 } else { pitch_mm[k] });
        let last = (rows - 1) as f64 * pitch_mm[1];
        let of_frame = self.frame_rows.map_or(0.0, |n| (n - 1.0) * pitch_mm[1]);
        let y = match first_row {
            FirstRow::Top => of_frame - y - last,
            FirstRow::SmallestY => y,
        };
        // No negative zero.
        [x + 0.0, y + 0.0]
    }
}

/// Content of a map file as stored, with all that the file states about it.
#[derive(Clone, Debug)]
pub struct Reading {
    /// Format that the file was read as.
    pub format: Format,
    /// Stored values (rows, columns) in the order of the file; NaN marks invalid pixels.
    pub values: Array2<f64>,
    /// True if the file stores 32-bit floats. A marker of invalid pixels is then rounded to 32 bits before it is
    /// compared with the values.
    pub single: bool,
    /// Unit of `offset + factor * value`; `None` if the file does not state it.
    pub unit: Option<Unit>,
    /// True if the file does not state the unit, so that `unit` is the one that writers of this format use.
    pub unit_by_custom: bool,
    /// Reason to refuse the unit of the file. With `override_file` the unit of the user replaces it; a unit that is
    /// only uncertain needs no `override_file`.
    pub unit_problem: Option<Invalid>,
    /// Unit as the file writes it, also if it is not understood; `None` if the file states none.
    pub unit_word: Option<String>,
    /// Unit that the file states without saying whether it is that of the values or that of the coordinates.
    pub lone_unit: Option<Unit>,
    /// Factor that the file states: height in `unit` per stored value.
    pub factor: f64,
    /// Height of the stored value 0, in `unit`; it is added after the multiplication by `factor`.
    pub offset: f64,
    /// Surface height per height of the wavefront that `factor` contains already, such as 0.5 for one reflection;
    /// `None` if the file does not state it.
    pub scale_applied: Option<f64>,
    /// Wavelength of the light, nm; `None` if the file does not state it.
    pub wavelength_nm: Option<f64>,
    /// Distance of pixel centres along [x, y], mm; `None` if the file does not state it.
    pub pixel_mm: Option<[f64; 2]>,
    /// Coordinates of all columns and rows; `None` if the file does not list them.
    pub coordinates: Option<Coordinates>,
    /// Rule of the coordinates; `None` if the header states none. `coordinates` has priority over it.
    pub rule: Option<Rule>,
    /// Position of the map in a larger frame, if the file states it.
    pub window: Option<Window>,
    /// Side of the map that the first row of the file is, by the statement of the file or the convention of the format.
    pub first_row: FirstRow,
    /// True if the file itself states which side the first row is; false if `first_row` is the convention of the
    /// format.
    pub first_row_stated: bool,
    /// Further statements of the file, recorded in the manifest of the artifact.
    pub stated: Value,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

impl Reading {
    /// Returns the reading of an artifact, a directory of `.npy` files: `map` (ny, nx) in nm or nm/s on `grid`.
    pub fn of_map(grid: &Grid, map: &Array2<f64>) -> Self {
        let mut reading = Self::new(Format::Directory, map.clone(), FirstRow::SmallestY);
        reading.unit = Some(Unit::named("nm"));
        reading.coordinates = Some(Coordinates {
            x: grid.x.coordinates(),
            y: grid.y.coordinates(),
            unit: Some(Unit::named("mm")),
        });
        reading
    }

    /// Returns a reading with the stored values alone: factor 1, offset 0, and none of the statements of a file.
    pub(crate) fn new(format: Format, values: Array2<f64>, first_row: FirstRow) -> Self {
        Self {
            format,
            values,
            single: false,
            unit: None,
            unit_by_custom: false,
            unit_problem: None,
            unit_word: None,
            lone_unit: None,
            factor: 1.0,
            offset: 0.0,
            scale_applied: None,
            wavelength_nm: None,
            pixel_mm: None,
            coordinates: None,
            rule: None,
            window: None,
            first_row,
            first_row_stated: false,
            stated: Value::Null,
            warnings: Vec::new(),
        }
    }

    /// Records the unit that the file calls `name` in its field `place`. A word that is no unit is refused later,
    /// unless the user overrides it.
    pub(crate) fn state_unit(&mut self, place: &'static str, name: &str) {
        self.unit_word = Some(name.to_string());
        match Unit::stated(place, name) {
            Ok(unit) => self.unit = Some(unit),
            Err(problem) => self.unit_problem = Some(problem),
        }
    }

    /// Records the unit at the end of the name of a variable, such as `height_nm` or `rate_nm_per_min`. A name without
    /// a unit changes nothing. A unit that is uncertain, or contradicts that of the file, becomes `unit_problem`.
    pub(crate) fn state_unit_of_name(&mut self, name: &str) {
        let mut words = name.rsplit('_');
        let time = words.next().unwrap_or_default();
        let length = words.next().unwrap_or_default();
        // Such as tif_nm_s: a slash is no letter of a name.
        let rate = Unit::spelled(&format!("{length}/{time}")).filter(|unit| unit.is_rate());
        let unit = rate.or_else(|| Unit::of_name(name).ok().and_then(|(_, unit)| unit));
        let Some(unit) = unit else { return };
        if name.ends_with("_in") || name.ends_with("_A") || name.ends_with(" A") {
            // It may be any word: an input, or the first of two maps.
            let problem = format!("may be {unit} by the name \"{name}\"");
            let remedy = "give `unit` to be sure";
            if self.unit.is_none() {
                self.unit_problem = Some(Invalid::whole("unit", problem, remedy));
            }
        } else if let Some(own) = self.unit.filter(|own| *own != unit) {
            let problem = format!("is {own} in the file, and {unit} in the name \"{name}\"");
            let remedy = "correct the one that is wrong, or give `unit` and `override_file`";
            self.unit_problem = Some(Invalid::whole("unit", problem, remedy));
        } else {
            self.unit = Some(unit);
        }
    }

    /// Makes the pixels invalid whose stored value is `marker`, and returns their number. The comparison uses the type
    /// of the stored values: -999.9 as a 32-bit float is not the 64-bit number of that name.
    pub(crate) fn invalidate(&mut self, marker: f64) -> usize {
        let marker = if self.single { f64::from(marker as f32) } else { marker };
        let mut count = 0;
        self.values.iter_mut().filter(|v| **v == marker).for_each(|v| {
            *v = f64::NAN;
            count += 1;
        });
        count
    }

    /// Makes the pixels invalid at which `mask`, called `name` in the file, is not 0. Refuses a mask of another shape.
    pub(crate) fn apply_mask(&mut self, name: &str, mask: &Array2<f64>) -> Result<(), Invalid> {
        if mask.dim() != self.values.dim() {
            let problem =
                format!("\"{name}\" has shape {:?}, the map {:?}", mask.dim(), self.values.dim());
            return Err(Invalid::whole("mask", problem, "give a mask of the size of the map"));
        }
        let mut count = 0;
        for (value, _) in self.values.iter_mut().zip(mask).filter(|(_, m)| **m != 0.0) {
            *value = f64::NAN;
            count += 1;
        }
        if count == 0 || count == mask.len() {
            let which = if count == 0 { "no" } else { "every" };
            self.warnings.push(format!("the mask \"{name}\" marks {which} pixel as invalid"));
        }
        Ok(())
    }
}

/// Place of the coordinate 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Origin {
    /// The place that the file gives; without coordinates in the file, the first pixel.
    File,
    /// The first pixel: smallest x, smallest y.
    Corner,
    /// The middle of the map.
    Centre,
}

/// Turn of the map, counter-clockwise with x to the right and y upwards.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
pub enum Rotation {
    /// 0 degrees.
    #[serde(rename = "0")]
    #[value(name = "0")]
    None,
    /// 90 degrees: what was on the right comes to the top.
    #[serde(rename = "90")]
    #[value(name = "90")]
    Quarter,
    /// 180 degrees.
    #[serde(rename = "180")]
    #[value(name = "180")]
    Half,
    /// 270 degrees: what was on the right comes to the bottom.
    #[serde(rename = "270")]
    #[value(name = "270")]
    ThreeQuarters,
}

/// Statements of the user about a file. With `None` the statement of the file counts.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ReadingSettings {
    /// True: a unit, pitch or wavelength of the user replaces a different one of the file, with a warning. False: a
    /// contradiction is refused.
    pub override_file: bool,
    /// Unit of the values in the file, of heights or rates.
    pub unit: Option<Unit>,
    /// Wavelength of the light, nm, for heights in waves.
    pub wavelength_nm: Option<f64>,
    /// Distance of pixel centres along [x, y], mm.
    pub pixel_mm: Option<[f64; 2]>,
    /// Unit of the coordinates that the file lists.
    pub coordinate_unit: Option<Unit>,
    /// Surface height per height in the file: 1 for a surface, 0.5 for the wavefront of one reflection. It multiplies
    /// all values.
    pub surface_per_value: f64,
    /// True if the file counts material (or removal) as negative, so that the sign is changed.
    pub negate: bool,
    /// Stored value that marks invalid pixels, besides NaN and the marker of the format.
    pub no_data: Option<f64>,
    /// Side of the map that the first row of the file is; `None` leaves it to the file or its format.
    pub first_row: Option<FirstRow>,
    /// True to mirror the map in x, so that its columns change order.
    pub flip_x: bool,
    /// True to mirror the map in y, so that its rows change order.
    pub flip_y: bool,
    /// Rotation of the map after mirroring, counter-clockwise.
    pub rotation: Rotation,
    /// Point of the map that gets the coordinates x = y = 0, unless `place_mm` gives coordinates.
    pub origin: Origin,
    /// Coordinates [x, y] that the pixel with the smallest x and y gets, mm; `None` leaves them to `origin`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub place_mm: Option<[f64; 2]>,
}

impl Default for ReadingSettings {
    fn default() -> Self {
        Self {
            override_file: false,
            unit: None,
            wavelength_nm: None,
            pixel_mm: None,
            coordinate_unit: None,
            surface_per_value: 1.0,
            negate: false,
            no_data: None,
            first_row: None,
            flip_x: false,
            flip_y: false,
            rotation: Rotation::None,
            origin: Origin::File,
            place_mm: None,
        }
    }
}

/// Conversion of the file that was applied, as the manifest records it.
#[derive(Clone, Debug, Serialize)]
pub struct Statement {
    /// Format that the file was read as.
    pub format: Format,
    /// Unit of the values in the file.
    pub unit: Unit,
    /// Source of the unit: "file", "custom of the format" or "asked for" (the user stated it).
    pub unit_from: &'static str,
    /// Change of the height in nm (or rate in nm/s) per stored value: all factors and the sign in one.
    pub nm_per_value: f64,
    /// Height in nm (or rate in nm/s) of the stored value 0.
    pub nm_of_zero: f64,
    /// Surface height per height in the file, such as 0.5 for the wavefront of one reflection.
    pub surface_per_value: f64,
    /// Distance of pixel centres along [x, y], mm, in the map that was written.
    pub pixel_mm: [f64; 2],
    /// Source of the pitch: "file" or "asked for" (the user stated it).
    pub pitch_from: &'static str,
    /// Side of the map that the first row of the file is.
    pub first_row: FirstRow,
    /// True if the map was mirrored in x.
    pub flip_x: bool,
    /// True if the map was mirrored in y.
    pub flip_y: bool,
    /// Rotation of the map after mirroring, degrees.
    pub rotation: Rotation,
    /// Number of invalid pixels of the map that was written.
    pub invalid: usize,
    /// Further statements of the file.
    pub stated: Value,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

impl Reading {
    /// Returns the usual origin of a tool influence function, if nobody states it. It is that of the coordinates in the
    /// file, also by a rule of known unit; without them it is the centre of the map.
    pub fn usual_tif_origin(&self, settings: &ReadingSettings) -> Origin {
        let by_rule = self.rule.as_ref().is_some_and(|rule| {
            rule.reference.is_some()
                && rule.unit.iter().all(|unit| unit.or(settings.coordinate_unit).is_some())
        });
        if self.coordinates.is_some() || by_rule { Origin::File } else { Origin::Centre }
    }
}

/// Converts a reading to a surface error map, with heights in nm on a grid in mm.
///
/// # Errors
/// Refuses a reading whose unit or pitch neither the file nor the settings state, settings that contradict the file or
/// are out of range, removal rates, and maps without a valid pixel.
pub fn surface(
    reading: Reading,
    settings: &ReadingSettings,
) -> Result<(Surface, Statement), Invalid> {
    let (grid, values, statement) = map(reading, settings, MapQuantity::Heights)?;
    Ok((Surface::new(grid, values)?, statement))
}

/// Converts a reading to a complete tool influence function (TIF): rates in nm/s at offsets from the tool centre. A
/// unit without a time counts as per second. A spot that must be cut out or divided by its time is read by
/// `planish tool` instead.
///
/// # Errors
/// Refuses what [`surface`] refuses, and rates of which [`Tif::new`] makes no TIF.
pub fn tif(reading: Reading, settings: &ReadingSettings) -> Result<(Tif, Statement), Invalid> {
    let (grid, values, statement) = map(reading, settings, MapQuantity::Rates)?;
    Ok((Tif::new(grid, values)?, statement))
}

/// Quantity that the values of a map have.
#[derive(Clone, Copy, PartialEq, Eq)]
enum MapQuantity {
    /// Heights, which are lengths.
    Heights,
    /// Removal rates, which are lengths per time; a unit without a time counts as per second.
    Rates,
}

/// Returns the grid (mm), the values (ny, nx) in nm or nm/s, and the statement of the conversion. Refuses a unit or
/// pitch that nobody states, settings that contradict the file or are out of range, and rates where heights are wanted.
fn map(
    mut reading: Reading,
    settings: &ReadingSettings,
    kind: MapQuantity,
) -> Result<(Grid, Array2<f64>, Statement), Invalid> {
    let mut warnings = std::mem::take(&mut reading.warnings);
    let (unit, unit_from) = unit(&reading, settings, kind, &mut warnings)?;
    if unit.is_rate() && kind == MapQuantity::Heights {
        let remedy = "planish tool from-maps reads rates by `rate`; leave out `dwell_s`";
        let problem = format!("of the values is {unit}, a removal rate, and heights are wanted");
        return Err(Invalid::whole("unit", problem, remedy));
    }
    let wavelength_nm = wavelength(&reading, unit, settings, &mut warnings)?;
    apply_surface_per_value(&mut reading, settings, &mut warnings)?;
    let Reading { factor, offset, .. } = reading;
    if !(factor.is_finite() && factor != 0.0 && offset.is_finite()) {
        let problem = format!("of the heights is {factor}, their offset {offset}");
        return Err(Invalid::whole("scale", problem, "correct the file, or export it again"));
    }
    let sign = if settings.negate { -1.0 } else { 1.0 };
    let unit_nm = unit.nm(wavelength_nm)?;
    let nm_per_value = sign * settings.surface_per_value * (factor * unit_nm);
    let nm_per_unit = sign * settings.surface_per_value * unit_nm;

    if let Some(no_data) = settings.no_data
        && reading.invalidate(no_data) == 0
    {
        warnings.push(format!("no pixel has the value {no_data}: `no_data` has no effect"));
    }
    warnings.extend(unnamed_marker(&reading.values));
    // height (nm) = (offset + factor x stored value) x nm_per_unit
    if offset == 0.0 {
        reading.values.mapv_inplace(|v| v * nm_per_value);
    } else {
        reading.values.mapv_inplace(|v| (offset + factor * v) * nm_per_unit);
    }
    let Placed { grid, values, first_row, pitch_from, has_coordinates } =
        place(&reading, settings, &mut warnings)?;
    let (mut grid, values) = turn(grid, values, settings);
    if has_coordinates {
        grid = turned_about_0(&grid, settings)?;
    }
    let grid = set_origin(grid, settings, has_coordinates, &mut warnings)?;
    let statement = Statement {
        format: reading.format,
        unit,
        unit_from,
        nm_per_value,
        nm_of_zero: offset * nm_per_unit,
        surface_per_value: settings.surface_per_value,
        pixel_mm: [grid.x.step_mm(), grid.y.step_mm()],
        pitch_from,
        first_row,
        flip_x: settings.flip_x,
        flip_y: settings.flip_y,
        rotation: settings.rotation,
        invalid: values.iter().filter(|v| v.is_nan()).count(),
        stated: reading.stated,
        warnings,
    };
    Ok((grid, values, statement))
}

/// Checks `surface_per_value`, and removes the factor that the file has applied if the setting replaces it (with
/// `override_file`). Refuses a setting that is not positive, and one other than 1 for a file with its own factor
/// without `override_file`.
fn apply_surface_per_value(
    reading: &mut Reading,
    settings: &ReadingSettings,
    warnings: &mut Vec<String>,
) -> Result<(), Invalid> {
    let requested = settings.surface_per_value;
    if !(requested.is_finite() && requested > 0.0) {
        let remedy = "give a positive factor, and `negate` for the other sign";
        return Err(Invalid::whole("surface_per_value", format!("is {requested}"), remedy));
    }
    let Some(applied) = reading.scale_applied.filter(|_| requested != 1.0) else { return Ok(()) };
    if !settings.override_file {
        let problem = format!("is {applied} in the file and applied, {requested} was asked for");
        let remedy = "leave out `surface_per_value`, or give `override_file`";
        return Err(Invalid::whole("surface_per_value", problem, remedy));
    }
    reading.factor /= applied;
    warnings
        .push(format!("`surface_per_value` {requested} takes the place of {applied} in the file"));
    Ok(())
}

/// Smallest distance of the smallest or largest stored value from all others, in ranges of these others, at which a
/// warning calls it a possible marker of invalid pixels. Larger: markers near the heights pass. Smaller: deep scratches
/// are doubted.
const FAR: f64 = 3.0;

/// Returns a warning if two or more pixels share the smallest or the largest stored value, more than [`FAR`] from all
/// others: it may mark invalid pixels. Otherwise it returns `None`.
fn unnamed_marker(values: &Array2<f64>) -> Option<String> {
    let finite = values.iter().copied().filter(|v| v.is_finite());
    let least = finite.clone().fold(f64::INFINITY, f64::min);
    let most = finite.clone().fold(f64::NEG_INFINITY, f64::max);
    for extreme in [least, most] {
        let others = finite.clone().filter(|v| *v != extreme);
        let low = others.clone().fold(f64::INFINITY, f64::min);
        let high = others.fold(f64::NEG_INFINITY, f64::max);
        let away = (low - extreme).max(extreme - high);
        let count = finite.clone().filter(|v| *v == extreme).count();
        if count >= 2 && high > low && away > FAR * (high - low) {
            return Some(format!(
                "{count} pixels have the stored value {extreme}, and all others lie between {low} and {high}: give \
                 `no_data` {extreme} where it marks invalid pixels"
            ));
        }
    }
    None
}

/// Returns the unit of the values, and its source ("file", "custom of the format" or "asked for"). Refuses a unit that
/// nobody states or understands, and a setting that contradicts the file without `override_file`.
fn unit(
    reading: &Reading,
    settings: &ReadingSettings,
    kind: MapQuantity,
    warnings: &mut Vec<String>,
) -> Result<(Unit, &'static str), Invalid> {
    if let Some(problem) = &reading.unit_problem {
        let is_settled = settings.override_file || problem.remedy == "give `unit` to be sure";
        return match settings.unit.filter(|_| is_settled) {
            None => Err(problem.clone()),
            Some(requested) => {
                let stated = format!("{}: {}", problem.array, problem.problem);
                warnings.push(format!("`unit` {requested} counts; the file: {stated}"));
                Ok((requested, "asked for"))
            }
        };
    }
    match (reading.unit, settings.unit) {
        (None, requested) => unit_of_user(reading, requested, settings, warnings),
        (Some(custom), None) if reading.unit_by_custom => {
            warnings.push(format!(
                "the file does not state the unit of its heights; writers of this format use \
                 {custom}; give `unit` to be sure"
            ));
            Ok((custom, "custom of the format"))
        }
        (Some(_), Some(requested)) if reading.unit_by_custom => Ok((requested, "asked for")),
        (Some(stated), Some(requested)) if !is_same_unit(requested, stated, kind) => {
            // The file states the length, the user its time.
            let adds_time = kind == MapQuantity::Rates
                && !stated.is_rate()
                && requested.is_rate()
                && requested.without_time() == stated;
            if !adds_time {
                let [a, b] = [stated, requested].map(|unit| unit.to_string());
                contradicts("unit", a, b, settings, warnings)?;
            }
            Ok((requested, "asked for"))
        }
        (Some(stated), _) => Ok((stated, "file")),
    }
}

/// Returns true if two units are the same. For rates, a length without a time is the same as that length per second.
fn is_same_unit(a: Unit, b: Unit, kind: MapQuantity) -> bool {
    let sizes = [a, b].map(|unit| unit.nm(Some(1.0)).unwrap_or(f64::NAN));
    a == b
        || kind == MapQuantity::Rates
            && a.is_waves() == b.is_waves()
            && a.is_rate() != b.is_rate()
            && agree(sizes[0], sizes[1])
}

/// Returns the unit and its source for a file that states none for its values. A unit that the file states without
/// saying of what is taken for the values, with a warning, unless the user states a unit. Refuses a unit of the user
/// that differs from it, except with `override_file` or if `coordinate_unit` is that unit. Refuses a unit that nobody
/// states.
fn unit_of_user(
    reading: &Reading,
    requested: Option<Unit>,
    settings: &ReadingSettings,
    warnings: &mut Vec<String>,
) -> Result<(Unit, &'static str), Invalid> {
    match (reading.lone_unit, requested) {
        (None, None) => Err(Invalid::whole(
            "unit",
            match warnings.iter().find(|warning| warning.starts_with("statements that")) {
                Some(unused) => format!("is not in the file ({unused})"),
                None => "is not in the file".into(),
            },
            "give `unit` m, mm, um, nm, angstrom, in, mil or waves, or a rate such as nm/min",
        )),
        (Some(lone), None) => {
            warnings.push(format!(
                "the file states the unit {lone}, and not of what: it is taken for the values; give `unit` to be sure"
            ));
            Ok((lone, "file"))
        }
        (Some(lone), Some(requested))
            if lone != requested && settings.coordinate_unit != Some(lone) =>
        {
            contradicts("unit", lone.to_string(), requested.to_string(), settings, warnings)?;
            Ok((requested, "asked for"))
        }
        (_, Some(requested)) => Ok((requested, "asked for")),
    }
}

/// Refuses a setting that contradicts the file, with both values in the message. With `override_file`, it adds a
/// warning instead.
fn contradicts(
    name: &'static str,
    stated: String,
    requested: String,
    settings: &ReadingSettings,
    warnings: &mut Vec<String>,
) -> Result<(), Invalid> {
    if settings.override_file {
        warnings.push(format!("`{name}` {requested} takes the place of {stated} in the file"));
        return Ok(());
    }
    Err(Invalid::whole(
        name,
        format!("is {stated} in the file, {requested} was asked for"),
        format!("leave out `{name}`, or give `override_file` where the file is wrong"),
    ))
}

/// Returns the wavelength that the settings or the file state, nm; `None` without one. A wavelength of the user for
/// heights in another unit than waves has no effect, or is refused if it contradicts the file. Refuses any other
/// contradiction without `override_file`.
fn wavelength(
    reading: &Reading,
    unit: Unit,
    settings: &ReadingSettings,
    warnings: &mut Vec<String>,
) -> Result<Option<f64>, Invalid> {
    match (reading.wavelength_nm, settings.wavelength_nm) {
        (Some(a), Some(b)) if !agree(a, b) => {
            if !unit.is_waves() {
                let [a, b] = [significant(a, 10), significant(b, 10)];
                let problem = format!("is {a} in the file, {b} was asked for");
                let remedy = "leave it out: the heights of this file are not in waves";
                return Err(Invalid::whole("wavelength_nm", problem, remedy));
            }
            contradicts(
                "wavelength_nm",
                significant(a, 10),
                significant(b, 10),
                settings,
                warnings,
            )?;
            Ok(Some(b))
        }
        (None, Some(_)) if !unit.is_waves() => {
            warnings.push(format!("the heights are in {unit:?}: `wavelength_nm` has no effect"));
            Ok(None)
        }
        (stated, requested) => Ok(requested.or(stated)),
    }
}

/// Returns true if two numbers agree to 1e-5 of the first, because writers keep 6 digits or more.
fn agree(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-5 * a.abs()
}

/// A map whose rows ascend in y and whose columns ascend in x, with its grid.
struct Placed {
    grid: Grid,
    values: Array2<f64>,
    first_row: FirstRow,
    pitch_from: &'static str,
    /// True if the grid has the coordinates of the file (listed, by a rule, or by a window); otherwise its first pixel
    /// is at 0.
    has_coordinates: bool,
}

/// Arranges the values on a grid in mm, by the coordinates of the file or by a pitch. Refuses coordinates without a
/// unit, a pitch beside coordinates without `override_file`, and what both ways refuse.
fn place(
    reading: &Reading,
    settings: &ReadingSettings,
    warnings: &mut Vec<String>,
) -> Result<Placed, Invalid> {
    let Some(coordinates) = &reading.coordinates else {
        return place_by_pitch(reading, settings, warnings);
    };
    let unit = coordinate_unit(coordinates.unit, settings, warnings)?;
    let in_pixels = unit.is_some_and(Unit::is_pixels);
    if in_pixels && settings.pixel_mm.is_none() {
        let remedy = "give `pixel_mm`, the distance of pixel centres";
        return Err(Invalid::whole("coordinate_unit", "is pixels", remedy));
    }
    if in_pixels {
        return place_by_coordinates(reading, coordinates, settings.pixel_mm.unwrap_or([1.0; 2]));
    }
    if let (Some(requested), true) = (settings.pixel_mm, settings.override_file) {
        warnings.push(format!(
            "`pixel_mm` {requested:?} takes the place of the coordinates in the file"
        ));
        return place_by_pitch(reading, settings, warnings);
    }
    if let Some(requested) = settings.pixel_mm {
        let [x, y] = [&coordinates.x, &coordinates.y].map(|c| match c[..] {
            [first, .., last] => (last - first) / (c.len() - 1) as f64,
            _ => 0.0,
        });
        let problem = format!(
            "{requested:?} was given, but the file has coordinates with the steps {x} and {y}"
        );
        let remedy = "leave it out; give `coordinate_unit` where the file does not state it (pixels, if they are \
                      numbers of pixels, together with `pixel_mm`)";
        return Err(Invalid::whole("pixel_mm", problem, remedy));
    }
    if settings.first_row.is_some() {
        let problem = "was given, but the file has coordinates";
        return Err(Invalid::whole("first_row", problem, "leave it out; `flip_y` mirrors"));
    }
    let unit = unit.ok_or_else(|| {
        Invalid::whole("coordinate_unit", "is not in the file", "give `coordinate_unit`")
    })?;
    place_by_coordinates(reading, coordinates, [unit.mm()?; 2])
}

/// Arranges the values on a grid by arrays of coordinates, so that both ascend. `unit_mm` is the size of the units of
/// the coordinates [x, y], mm. Refuses coordinates that are not one per pixel in equal steps.
fn place_by_coordinates(
    reading: &Reading,
    coordinates: &Coordinates,
    unit_mm: [f64; 2],
) -> Result<Placed, Invalid> {
    let values = &reading.values;
    let (rows, columns) = values.dim();
    let (x, x_descends) = ascending("x", &coordinates.x, columns, unit_mm[0])?;
    let (y, y_descends) = ascending("y", &coordinates.y, rows, unit_mm[1])?;
    let mut view = values.view();
    if x_descends {
        view.invert_axis(ndarray::Axis(1));
    }
    if y_descends {
        view.invert_axis(ndarray::Axis(0));
    }
    let first_row = if y_descends { FirstRow::Top } else { FirstRow::SmallestY };
    Ok(Placed {
        grid: Grid { x, y },
        values: view.to_owned(),
        first_row,
        pitch_from: "file",
        has_coordinates: true,
    })
}

/// Returns the uniform axis of `len` pixels through the coordinates, and true if they descend. `to_mm` is the size of
/// their unit, mm; `name` is for messages. Refuses another number of coordinates, and steps that are not equal.
fn ascending(
    name: &'static str,
    coordinates: &[f64],
    len: usize,
    to_mm: f64,
) -> Result<(Axis, bool), Invalid> {
    if coordinates.len() != len {
        let problem = format!("has {} coordinates for {len} pixels", coordinates.len());
        return Err(Invalid::whole(name, problem, "give one per pixel"));
    }
    let mut mm: Vec<f64> = coordinates.iter().map(|v| v * to_mm).collect();
    let descends = mm.first() > mm.last();
    if descends {
        mm.reverse();
    }
    Ok((Axis::from_coordinates(name, &mm)?, descends))
}

/// Returns the unit of the coordinates that the user or the file states; `None` without either. Refuses a contradiction
/// without `override_file`.
fn coordinate_unit(
    stated: Option<Unit>,
    settings: &ReadingSettings,
    warnings: &mut Vec<String>,
) -> Result<Option<Unit>, Invalid> {
    if let (Some(a), Some(b)) = (stated, settings.coordinate_unit)
        && a != b
    {
        contradicts("coordinate_unit", a.to_string(), b.to_string(), settings, warnings)?;
    }
    Ok(settings.coordinate_unit.or(stated))
}

/// Returns the distance of pixel centres [x, y], mm, and its source ("file" or "asked for"). Refuses a contradiction
/// without `override_file`, a missing pitch, and one that is not positive.
fn pitch(
    of_file: Option<[f64; 2]>,
    settings: &ReadingSettings,
    warnings: &mut Vec<String>,
) -> Result<([f64; 2], &'static str), Invalid> {
    let (pitch, pitch_from) = match (settings.pixel_mm, of_file) {
        (None, None) => {
            return Err(Invalid::whole(
                "pixel_mm",
                "is not in the file",
                "give `pixel_mm`, the distance of pixel centres",
            ));
        }
        (Some(requested), stated) => {
            if let Some(s) = stated
                && !(agree(s[0], requested[0]) && agree(s[1], requested[1]))
            {
                let [a, b] = [s, requested]
                    .map(|p| format!("{} x {} mm", significant(p[0], 10), significant(p[1], 10)));
                contradicts("pixel_mm", a, b, settings, warnings)?;
            }
            (requested, "asked for")
        }
        (None, Some(stated)) => (stated, "file"),
    };
    for pitch in pitch {
        if !(pitch.is_finite() && pitch > 0.0) {
            let remedy = "a pitch is positive; give `pixel_mm`";
            return Err(Invalid::whole("pixel_mm", format!("is {pitch}"), remedy));
        }
    }
    Ok((pitch, pitch_from))
}

/// Arranges the values of a file without arrays of coordinates, so that both coordinates ascend: by its [`Rule`], or by
/// a pitch alone. Refuses a missing pitch, a rule whose unit nobody states, and settings for which the file has no use.
fn place_by_pitch(
    reading: &Reading,
    settings: &ReadingSettings,
    warnings: &mut Vec<String>,
) -> Result<Placed, Invalid> {
    if settings.coordinate_unit.is_some() && reading.rule.is_none() {
        return Err(Invalid::whole(
            "coordinate_unit",
            "was given, but no coordinates are read from the file",
            "leave out `coordinate_unit`, or name the arrays with `x` and `y`",
        ));
    }
    let mut rule = None;
    if let Some(stated) = &reading.rule {
        match in_mm(stated, settings, warnings)? {
            None if settings.pixel_mm.is_none() => {
                let problem = format!("of the steps {:?} is not in the file", stated.step);
                let remedy = "give `coordinate_unit`, or `pixel_mm` in the place of the steps";
                return Err(Invalid::whole("coordinate_unit", problem, remedy));
            }
            None => warnings.push(format!(
                "the header has the steps {:?} without their unit: neither they nor where the pixels lie \
                 are used; give `coordinate_unit` in the place of `pixel_mm`",
                stated.step
            )),
            in_mm => rule = in_mm,
        }
    }
    let of_file = rule.as_ref().map(|rule| rule.step.map(f64::abs)).or(reading.pixel_mm);
    let (pitch, pitch_from) = pitch(of_file, settings, warnings)?;
    let reference = rule.as_ref().and_then(|rule| rule.reference);
    if reference.is_some() && settings.first_row.is_some() {
        let problem = "was given, but the file says where its rows lie";
        return Err(Invalid::whole("first_row", problem, "leave it out; `flip_y` mirrors"));
    }
    if let Some(requested) = settings.first_row
        && reading.first_row_stated
        && requested != reading.first_row
    {
        let [a, b] = [reading.first_row, requested]
            .map(|row| if row == FirstRow::Top { "top".into() } else { "bottom".into() });
        contradicts("first_row", a, b, settings, warnings)?;
    }
    let mut view = reading.values.view();
    let first_row = settings.first_row.unwrap_or(reading.first_row);
    let window = reading.window.filter(|_| rule.is_none());
    let start_mm = window.map(|window| window.start_mm(pitch, reading.values.nrows(), first_row));
    if first_row == FirstRow::Top {
        view.invert_axis(ndarray::Axis(0));
    }
    let descends = rule.map_or([false; 2], |rule| rule.step.map(|step| step < 0.0));
    let mut axes = [None; 2];
    for (k, len) in [reading.values.ncols(), reading.values.nrows()].into_iter().enumerate() {
        if descends[k] {
            let axis = ["first", "second"][k];
            warnings.push(format!("the {axis} axis of the file descends: it was reversed"));
            view.invert_axis(ndarray::Axis(1 - k));
        }
        // coordinate of the first pixel of an ascending axis = coordinate - pitch (pixel - first pixel)
        let start = reference.map_or(start_mm.map_or(0.0, |start| start[k]), |pixels| {
            let (pixel, coordinate_mm) = pixels[k];
            let last = (len - 1) as f64;
            coordinate_mm - pitch[k] * if descends[k] { last - pixel } else { pixel }
        });
        axes[k] = Some(Axis::new(start, pitch[k], len)?);
    }
    let [Some(x), Some(y)] = axes else { unreachable!("both were made") };
    Ok(Placed {
        grid: Grid { x, y },
        values: view.to_owned(),
        first_row,
        pitch_from,
        has_coordinates: reference.is_some() || window.is_some(),
    })
}

/// Returns the rule of the coordinates in mm, or `None` if neither the file nor the user states its unit. Refuses a
/// unit that is no length, and a contradiction.
fn in_mm(
    rule: &Rule,
    settings: &ReadingSettings,
    warnings: &mut Vec<String>,
) -> Result<Option<Rule>, Invalid> {
    let mut in_mm = rule.clone();
    for (k, stated) in rule.unit.iter().enumerate() {
        let Some(unit) = coordinate_unit(*stated, settings, warnings)? else { return Ok(None) };
        let to_mm = unit.mm()?;
        in_mm.step[k] *= to_mm;
        in_mm.unit[k] = Some(Unit::named("mm"));
        if let Some(reference) = &mut in_mm.reference {
            reference[k].1 *= to_mm;
        }
    }
    Ok(Some(in_mm))
}

/// Mirrors the map, then turns it. A mirrored axis keeps its coordinates; a quarter turn swaps the axes.
/// [`turned_about_0`] corrects the coordinates if they are those of the file.
fn turn(grid: Grid, values: Array2<f64>, settings: &ReadingSettings) -> (Grid, Array2<f64>) {
    let mut view = values.view();
    // Half a turn mirrors both axes.
    let is_half = settings.rotation == Rotation::Half;
    if settings.flip_x != is_half {
        view.invert_axis(ndarray::Axis(1));
    }
    if settings.flip_y != is_half {
        view.invert_axis(ndarray::Axis(0));
    }
    // 90 degrees: (x, y) -> (-y, x); 270 degrees: (x, y) -> (y, -x)
    let swapped = Grid { x: grid.y, y: grid.x };
    match settings.rotation {
        Rotation::None | Rotation::Half => (grid, view.to_owned()),
        Rotation::Quarter => {
            let mut turned = view.reversed_axes();
            turned.invert_axis(ndarray::Axis(1));
            (swapped, turned.as_standard_layout().into_owned())
        }
        Rotation::ThreeQuarters => {
            let mut turned = view.reversed_axes();
            turned.invert_axis(ndarray::Axis(0));
            (swapped, turned.as_standard_layout().into_owned())
        }
    }
}

/// Returns the grid of a map that was mirrored or turned, with coordinates that are mirrored and turned like its
/// pixels. So x = y = 0 stays at the same point of the part. `grid` has the coordinates before this correction, as
/// `turn` returns them.
fn turned_about_0(grid: &Grid, settings: &ReadingSettings) -> Result<Grid, Invalid> {
    let [x, y] = [settings.flip_x, settings.flip_y].map(|flip| if flip { -1.0 } else { 1.0 });
    // Sign of the coordinate of the file that became x, and of the one that became y; 90 degrees: (x, y) -> (-y, x)
    let [along_x, along_y] = match settings.rotation {
        Rotation::None => [x, y],
        Rotation::Quarter => [-y, x],
        Rotation::Half => [-x, -y],
        Rotation::ThreeQuarters => [y, -x],
    };
    let [x, y] = [(&grid.x, along_x), (&grid.y, along_y)].map(|(axis, sign)| {
        started_at(axis, if sign < 0.0 { -axis.end_mm() } else { axis.start_mm() })
    });
    Ok(Grid { x: x?, y: y? })
}

/// Returns the axis with the first coordinate `start_mm`, and the same pixels and pitch.
fn started_at(axis: &Axis, start_mm: f64) -> Result<Axis, Invalid> {
    Axis::new(start_mm, axis.step_mm(), axis.len())
}

/// Returns the grid with x = y = 0 at the `origin` of the settings, or with its first pixel at their `place_mm`.
/// `has_place` is true if the file states coordinates. Refuses `place_mm` with another `origin` than the file, and one
/// that contradicts the coordinates of the file without `override_file`.
fn set_origin(
    grid: Grid,
    settings: &ReadingSettings,
    has_place: bool,
    warnings: &mut Vec<String>,
) -> Result<Grid, Invalid> {
    let start_mm = [grid.x.start_mm(), grid.y.start_mm()];
    if let Some(place) = settings.place_mm {
        if settings.origin != Origin::File {
            let problem = "was given beside `origin`";
            return Err(Invalid::whole("place_mm", problem, "give one of them"));
        }
        let apart = [&grid.x, &grid.y]
            .into_iter()
            .enumerate()
            .any(|(k, axis)| (place[k] - start_mm[k]).abs() > 1e-3 * axis.step_mm());
        if has_place && apart {
            let [a, b] = [start_mm, place]
                .map(|p| format!("{}, {} mm", significant(p[0], 8), significant(p[1], 8)));
            contradicts("place_mm", a, b, settings, warnings)?;
        }
        let [x, y] = place;
        return Ok(Grid { x: started_at(&grid.x, x)?, y: started_at(&grid.y, y)? });
    }
    let [x, y] = [&grid.x, &grid.y].map(|axis| {
        let start_mm = match settings.origin {
            Origin::File => axis.start_mm(),
            Origin::Corner => 0.0,
            Origin::Centre => -0.5 * (axis.len() - 1) as f64 * axis.step_mm(),
        };
        started_at(axis, start_mm)
    });
    Ok(Grid { x: x?, y: y? })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    /// Returns a reading of two rows and three columns, with all values different.
    fn reading() -> Reading {
        let values = array![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];
        let mut reading = Reading::new(Format::Npy, values, FirstRow::SmallestY);
        reading.unit = Some(Unit::named("um"));
        reading.pixel_mm = Some([0.5, 0.25]);
        reading
    }

    fn height(settings: &ReadingSettings) -> Array2<f64> {
        surface(reading(), settings).unwrap().0.height_nm().clone()
    }

    #[test]
    fn every_orientation_by_hand() {
        let k = 1e3;
        let set = |change: fn(&mut ReadingSettings)| {
            let mut settings = ReadingSettings::default();
            change(&mut settings);
            height(&settings) / k
        };
        assert_eq!(set(|_| ()), array![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
        let top = set(|s| s.first_row = Some(FirstRow::Top));
        assert_eq!(top, array![[4.0, 5.0, 6.0], [1.0, 2.0, 3.0]]);
        assert_eq!(set(|s| s.flip_x = true), array![[3.0, 2.0, 1.0], [6.0, 5.0, 4.0]]);
        assert_eq!(set(|s| s.flip_y = true), top);
        // Seen with y upwards: 4 5 6 over 1 2 3. A quarter turn to the left puts the right
        // column (6 over 3) on top, 6 on the left.
        let quarter = set(|s| s.rotation = Rotation::Quarter);
        assert_eq!(quarter, array![[4.0, 1.0], [5.0, 2.0], [6.0, 3.0]]);
        let half = set(|s| s.rotation = Rotation::Half);
        assert_eq!(half, array![[6.0, 5.0, 4.0], [3.0, 2.0, 1.0]]);
        let three = set(|s| s.rotation = Rotation::ThreeQuarters);
        assert_eq!(three, array![[3.0, 6.0], [2.0, 5.0], [1.0, 4.0]]);
        assert_eq!(set(|s| s.negate = true), -array![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
    }

    #[test]
    fn a_quarter_turn_takes_the_pitch_with_it_and_the_centre_is_the_origin() {
        let settings = ReadingSettings {
            rotation: Rotation::Quarter,
            origin: Origin::Centre,
            ..ReadingSettings::default()
        };
        let (surface, statement) = surface(reading(), &settings).unwrap();
        assert_eq!(statement.pixel_mm, [0.25, 0.5]);
        let grid = surface.grid();
        assert_eq!((grid.x.start_mm(), grid.y.start_mm()), (-0.125, -0.5));
        assert_eq!((grid.x.end_mm(), grid.y.end_mm()), (0.125, 0.5));
    }

    #[test]
    fn the_coordinate_0_turns_with_the_samples() {
        // Offsets -1, 0, 1, 2 mm along x and 0, 0.5, 1 mm along y; 9 nm/s at (0, 0.5).
        let values = array![[1.0, 2.0, 3.0, 4.0], [5.0, 9.0, 6.0, 7.0], [8.0, 1.0, 2.0, 3.0]];
        let reading = || {
            let mut reading = Reading::new(Format::Npy, values.clone(), FirstRow::SmallestY);
            let (x, y) = (vec![-1.0, 0.0, 1.0, 2.0], vec![0.0, 0.5, 1.0]);
            reading.unit = Some(Unit::named("nm"));
            reading.coordinates = Some(Coordinates { x, y, unit: Some(Unit::named("mm")) });
            reading
        };
        for flip_x in [false, true] {
            for flip_y in [false, true] {
                for (rotation, cos, sin) in [
                    (Rotation::None, 1.0, 0.0),
                    (Rotation::Quarter, 0.0, 1.0),
                    (Rotation::Half, -1.0, 0.0),
                    (Rotation::ThreeQuarters, 0.0, -1.0),
                ] {
                    let settings =
                        ReadingSettings { flip_x, flip_y, rotation, ..ReadingSettings::default() };
                    let made = tif(reading(), &settings).unwrap().0;
                    // A map of heights lies on the same pixels.
                    assert_eq!(surface(reading(), &settings).unwrap().0.grid(), made.grid());
                    for (r, y) in [0.0, 0.5, 1.0].into_iter().enumerate() {
                        for (c, x) in [-1.0, 0.0, 1.0, 2.0].into_iter().enumerate() {
                            let u = if flip_x { -x } else { x };
                            let v = if flip_y { -y } else { y };
                            let rate = made.rate_at(cos * u - sin * v, sin * u + cos * v);
                            // At a sample the interpolation gives the sample: rounding of the coordinates, times slopes
                            // of some ten per mm.
                            assert!((rate - values[[r, c]]).abs() < 1e-9, "{settings:?} {x} {y}");
                        }
                    }
                    // The middle of the samples is asked for, and stays there.
                    let settings = ReadingSettings { origin: Origin::Centre, ..settings };
                    let g = *tif(reading(), &settings).unwrap().0.grid();
                    assert_eq!(
                        [g.x.start_mm() + g.x.end_mm(), g.y.start_mm() + g.y.end_mm()],
                        [0.0; 2]
                    );
                }
            }
        }
    }

    #[test]
    fn nothing_is_guessed_and_contradictions_are_refused() {
        let message = |change: &dyn Fn(&mut Reading), settings: &ReadingSettings| {
            let mut reading = reading();
            change(&mut reading);
            surface(reading, settings).unwrap_err().to_string()
        };
        let plain = ReadingSettings::default();
        assert!(message(&|r| r.unit = None, &plain).contains("give `unit`"));
        assert!(message(&|r| r.pixel_mm = None, &plain).contains("give `pixel_mm`"));
        assert!(
            message(&|r| r.unit = Some(Unit::named("waves")), &plain).contains("`wavelength_nm`")
        );
        assert!(message(&|r| r.pixel_mm = Some([0.1, 0.0]), &plain).contains("pixel_mm: is 0"));
        let requested = ReadingSettings { unit: Some(Unit::named("nm")), ..plain.clone() };
        assert!(message(&|_| (), &requested).contains("um in the file, nm was asked for"));
        let requested = ReadingSettings { pixel_mm: Some([0.5, 0.3]), ..plain.clone() };
        let said = message(&|_| (), &requested);
        assert!(said.contains("0.5 x 0.25 mm in the file, 0.5 x 0.3 mm was asked for"), "{said}");
        let requested = ReadingSettings { surface_per_value: 0.5, ..plain.clone() };
        let said = message(&|r| r.scale_applied = Some(0.5), &requested);
        assert!(said.contains("is 0.5 in the file and applied"), "{said}");
        let requested = ReadingSettings { wavelength_nm: Some(600.0), ..plain.clone() };
        let said = message(&|r| r.wavelength_nm = Some(632.8), &requested);
        assert!(said.contains("is 632.8 in the file, 600 was asked for"), "{said}");
        let requested = ReadingSettings { pixel_mm: Some([-1.0; 2]), ..plain.clone() };
        assert!(message(&|r| r.pixel_mm = None, &requested).contains("pixel_mm: is -1"));
        assert!(message(&|r| r.factor = 0.0, &plain).contains("of the heights is 0"));
        let coordinates = Coordinates { x: vec![0.0, 1.0, 2.0], y: vec![1.0, 0.0], unit: None };
        let with = |r: &mut Reading| r.coordinates = Some(coordinates.clone());
        assert!(message(&with, &plain).contains("give `coordinate_unit`"));
        let requested =
            ReadingSettings { coordinate_unit: Some(Unit::named("waves")), ..plain.clone() };
        assert!(message(&with, &requested).contains("is waves"));
        assert!(Unit::stated("BUNIT", "furlong").unwrap_err().to_string().contains("furlong"));
    }

    #[test]
    fn the_name_of_a_variable_has_its_unit() {
        for (name, unit) in [
            ("height_nm", "nm"),
            ("rate_nm_per_min", "nm/min"),
            ("tif_nm_s", "nm/s"),
            ("TIF_nm_min", "nm/min"),
            ("removal_um_h", "um/h"),
            ("Z", "-"),
            ("z_min", "-"),
            ("depth_s", "-"),
            ("map_in", "unclear"),
            ("surface_A", "unclear"),
        ] {
            let mut reading = Reading::new(Format::Npy, Array2::zeros((2, 2)), FirstRow::SmallestY);
            reading.state_unit_of_name(name);
            let found = match (&reading.unit, &reading.unit_problem) {
                (Some(unit), None) => unit.to_string(),
                (None, None) => "-".into(),
                _ => "unclear".into(),
            };
            assert_eq!(found, unit, "{name}");
        }
    }

    #[test]
    fn descending_coordinates_turn_the_map() {
        let mut reading = reading();
        reading.coordinates = Some(Coordinates {
            x: vec![2.0, 1.0, 0.0],
            y: vec![7.0, 6.0],
            unit: Some(Unit::named("m")),
        });
        let (surface, statement) = surface(reading, &ReadingSettings::default()).unwrap();
        assert_eq!(surface.height_nm() / 1e3, array![[6.0, 5.0, 4.0], [3.0, 2.0, 1.0]]);
        assert_eq!(surface.grid().y.start_mm(), 6000.0);
        assert_eq!((statement.first_row, statement.pitch_from), (FirstRow::Top, "file"));
    }

    #[test]
    fn a_value_far_from_all_others_is_doubted() {
        let mut values = Array2::from_shape_fn((4, 5), |(r, c)| (r * 5 + c) as f64);
        assert_eq!(unnamed_marker(&values), None);
        // The others go from 1 to 18: three ranges are 51.
        (values[[0, 0]], values[[3, 4]]) = (-51.0, -51.0);
        assert!(unnamed_marker(&values).unwrap().contains("2 pixels have the stored value -51"));
        (values[[0, 0]], values[[3, 4]]) = (-50.0, -50.0);
        assert_eq!(unnamed_marker(&values), None);
        // One pixel is a spike.
        (values[[0, 0]], values[[3, 4]]) = (1e9, 2.0);
        assert_eq!(unnamed_marker(&values), None);
    }

    #[test]
    fn a_pitch_overrides_with_a_warning_and_no_data_is_nan() {
        let settings = ReadingSettings {
            override_file: true,
            pixel_mm: Some([0.1, 0.1]),
            no_data: Some(5.0),
            surface_per_value: 0.5,
            ..ReadingSettings::default()
        };
        let (surface, statement) = surface(reading(), &settings).unwrap();
        assert_eq!(statement.warnings.len(), 1);
        assert_eq!((statement.invalid, statement.nm_per_value), (1, 500.0));
        assert!(surface.height_nm()[[1, 1]].is_nan());
        assert_eq!(surface.height_nm()[[1, 2]], 3000.0);
    }
}
