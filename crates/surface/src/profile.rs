//! A profile: heights or slopes along a line, as a long-trace profiler or an autocollimator measures them.
//!
//! A file of a profile is a table of numbers, one line per position. The lines before the first one with a
//! number in both columns are its header, and lines of text may follow the numbers. The user states the columns and the
//! unit of the values, which decides whether they are heights or slopes. A unit in the file must be the same.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | x | `position_mm` | (n), ascending | mm |
//! | z | [`Values::HeightNm`] | (n), NaN = invalid | nm |
//! | z' | [`Values::SlopeNrad`] | (n), NaN = invalid | nrad |

use planish_types::{
    Invalid, file_text,
    units::{Header, Quantity, Unit},
};
use serde::Serialize;

/// Smallest number of positions with a value; fewer are refused. Larger: refuses short profiles. Smaller: a
/// spectrum of so few positions is meaningless.
pub const MIN_POSITIONS: usize = 8;

/// Largest deviation of a step between positions from the mean step, relative to it, up to which steps count as equal.
/// Larger: uneven positions are taken for even ones, and frequencies are wrong by as much. Smaller: positions that are
/// rounded in the file are interpolated.
const UNIFORMITY: f64 = 0.01;

/// Largest plausible magnitude of a position, mm. A larger value is refused, because its unit is wrong. Chosen:
/// the same as for the coordinates of maps.
const LARGEST_POSITION_MM: f64 = 1e7;

/// Largest plausible magnitude of a height, nm. A larger value is refused, because its unit is wrong.
const LARGEST_HEIGHT_NM: f64 = 1e12;

/// Largest plausible magnitude of a slope, nrad: 1 rad. A larger value is refused, because its unit is wrong.
const LARGEST_SLOPE_NRAD: f64 = 1e9;

/// Columns and units of a profile in its file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ProfileSettings {
    /// Column of the positions and column of the values, counted from 1.
    pub columns: [usize; 2],
    /// Unit of the positions; `None` for the one that the file states, and mm where it states none.
    pub position_unit: Option<Unit>,
    /// Unit of the values. A unit of length makes them heights, a unit of angle slopes.
    pub value_unit: Unit,
    /// Number of lines before the numbers; `None` for all lines up to the first one that has a number in both columns.
    pub header_lines: Option<usize>,
}

/// Measured values of a profile (n); NaN marks an invalid one.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Heights, nm.
    HeightNm(Vec<f64>),
    /// Slopes, nrad.
    SlopeNrad(Vec<f64>),
}

/// A measured line: heights or slopes at ascending positions; see the module.
#[derive(Clone, Debug, PartialEq)]
pub struct Profile {
    position_mm: Vec<f64>,
    values: Values,
}

impl Profile {
    /// Makes a profile of values at positions, mm. Positions that descend are reversed together with the values.
    ///
    /// # Errors
    /// Refuses another number of values than of positions, less than [`MIN_POSITIONS`] valid values, numbers that are
    /// not finite or implausibly large, and positions that neither ascend nor descend.
    pub fn new(mut position_mm: Vec<f64>, mut values: Values) -> Result<Self, Invalid> {
        let (name, unit, largest, v) = match &mut values {
            Values::HeightNm(v) => ("height", "nm", LARGEST_HEIGHT_NM, v),
            Values::SlopeNrad(v) => ("slope", "nrad", LARGEST_SLOPE_NRAD, v),
        };
        if v.len() != position_mm.len() {
            let problem = format!("has {} values at {} positions", v.len(), position_mm.len());
            return Err(Invalid::whole("profile", problem, "give one value per position"));
        }
        let valid = v.iter().filter(|v| !v.is_nan()).count();
        if valid < MIN_POSITIONS {
            let problem = format!("has {valid} valid value(s)");
            let remedy = format!("give at least {MIN_POSITIONS}; check its columns");
            return Err(Invalid::whole("profile", problem, remedy));
        }
        let is_wrong = |x: &f64| x.is_nan() || x.abs() > LARGEST_POSITION_MM;
        if let Some(i) = position_mm.iter().position(is_wrong) {
            let problem = format!("is {} mm", position_mm[i]);
            let remedy = "give a finite number, and check `position_unit`";
            return Err(Invalid::at_index("position", i, problem, remedy));
        }
        if let Some(i) = v.iter().position(|v| v.abs() > largest) {
            let problem = format!("is {} {unit}", v[i]);
            let remedy = "give a finite number, and check `value_unit`";
            return Err(Invalid::at_index(name, i, problem, remedy));
        }
        if position_mm[position_mm.len() - 1] < position_mm[0] {
            position_mm.reverse();
            v.reverse();
        }
        if let Some(i) = (1..position_mm.len()).find(|i| position_mm[*i] <= position_mm[i - 1]) {
            let problem = format!("{} mm follows {} mm", position_mm[i], position_mm[i - 1]);
            let remedy = "sort the lines by position, and leave only one of equal ones";
            return Err(Invalid::at_index("position", i, problem, remedy));
        }
        Ok(Self { position_mm, values })
    }

    /// Makes a profile from the rows [position, value] of a file, which are in the units of the file. Refuses units of
    /// other quantities, and what [`Self::new`] refuses.
    pub fn from_rows(rows: &ProfileRows, settings: &ProfileSettings) -> Result<Self, Invalid> {
        let unit = settings.position_unit.or(rows.position_unit);
        let to_mm = match unit {
            None => 1.0,
            Some(unit) if unit.quantity() == Quantity::Length => unit.size(-3),
            Some(unit) => {
                let remedy = "give the unit of a length: m, mm, um, in";
                return Err(Invalid::whole("position_unit", format!("is {unit}"), remedy));
            }
        };
        let rows = &rows.rows;
        let position_mm = rows.iter().map(|r| to_mm * r[0]).collect();
        let value_unit = settings.value_unit;
        let values = rows.iter().map(|r| value_unit.size(-9) * r[1]).collect();
        let values = match value_unit.quantity() {
            Quantity::Length => Values::HeightNm(values),
            Quantity::Angle => Values::SlopeNrad(values),
            _ => {
                let problem = format!("is {value_unit}");
                let remedy = "give the unit of a length for heights (nm, um), or of an angle for slopes (urad, arcsec)";
                return Err(Invalid::whole("value_unit", problem, remedy));
            }
        };
        Self::new(position_mm, values)
    }

    /// Returns the positions (n), mm, ascending.
    pub fn position_mm(&self) -> &[f64] {
        &self.position_mm
    }

    /// Returns the heights, nm, or slopes, nrad (n).
    pub fn values(&self) -> &Values {
        &self.values
    }

    /// Returns the mean step between neighbouring positions, mm.
    pub fn step_mm(&self) -> f64 {
        let x = &self.position_mm;
        (x[x.len() - 1] - x[0]) / (x.len() - 1) as f64
    }

    /// Returns the smallest and the largest step between positions, mm, or `None` if no step differs by more than 1 %
    /// from the mean step.
    pub fn uneven_steps_mm(&self) -> Option<[f64; 2]> {
        let steps = self.position_mm.windows(2).map(|w| w[1] - w[0]);
        let [low, high] = steps.fold([f64::INFINITY, 0.0_f64], |[l, h], s| [l.min(s), h.max(s)]);
        let mean = self.step_mm();
        let is_uneven = mean - low > UNIFORMITY * mean || high - mean > UNIFORMITY * mean;
        if is_uneven { Some([low, high]) } else { None }
    }
}

/// Rows of the file of a profile, in the units of the file.
#[derive(Clone, Debug, PartialEq)]
pub struct ProfileRows {
    /// Position and value of every line of numbers; the value is NaN where it is invalid.
    pub rows: Vec<[f64; 2]>,
    /// Unit of the positions; `None` if the file states none.
    pub position_unit: Option<Unit>,
    /// Warnings for the user, such as on decimal commas.
    pub warnings: Vec<String>,
}

/// Reads the position and the value in every line of a text.
///
/// # Errors
/// Refuses a text without a line of numbers in both columns, a unit above the numbers that is not that of the settings,
/// and a line among the numbers that is none.
pub fn rows_of_text(bytes: &[u8], settings: &ProfileSettings) -> Result<ProfileRows, Invalid> {
    let text = file_text::text("profile", bytes).map_err(|e| Invalid {
        remedy: "export it as a table of text, or save it with numpy.save as .npy".into(),
        ..e
    })?;
    let columns = settings.columns;
    let skipped = settings.header_lines.unwrap_or(0);
    let mut lines = text.lines().enumerate().skip(skipped);
    let Some((first, line)) = lines.find(|(_, line)| begins_numbers(line, columns)) else {
        let [position, value] = columns;
        let problem = format!("has no line with numbers in the columns {position} and {value}");
        let remedy = "give the right `profile_columns`, or save two columns of numbers";
        return Err(Invalid::whole("profile", problem, remedy));
    };
    let mut profile = ProfileRows { rows: Vec::new(), position_unit: None, warnings: Vec::new() };
    if settings.header_lines.is_none() {
        let above: Vec<&str> = text.lines().take(first).collect();
        profile.position_unit = check_header(&above, file_text::fields(line).count(), settings)?;
    }
    let start: usize = text.split_inclusive('\n').take(first).map(str::len).sum();
    let body = &text[start..];
    let converted = match row_of_line(line, columns) {
        Ok(_) => None,
        Err(_) => file_text::with_points("profile", body)?,
    };
    let body = converted.as_deref().unwrap_or(body);
    if converted.is_some() {
        profile.warnings.push(file_text::DECIMAL_COMMAS.into());
    }
    let mut lines = body.lines().enumerate();
    while let Some((i, line)) = lines.next() {
        let trimmed = line.trim();
        // A quote alone closes the numbers of an .slp2 file.
        if trimmed.is_empty() || trimmed == "\"" || trimmed.starts_with(['#', '%', '!']) {
            continue;
        }
        match row_of_line(line, columns) {
            Ok(row) => profile.rows.push(row),
            Err(problem) => {
                let number = first + i + 1;
                let begins_with_number =
                    trimmed.starts_with(|c: char| c.is_ascii_digit() || c == '-');
                if begins_with_number || lines.any(|(_, line)| row_of_line(line, columns).is_ok()) {
                    let remedy = "write numbers with a decimal point; give the right `profile_columns` \
                                  and `header_lines`";
                    let problem = format!("{problem} in line {number}");
                    return Err(Invalid::whole("profile", problem, remedy));
                }
                let short: String = trimmed.chars().filter(|c| !c.is_control()).take(40).collect();
                profile.warnings.push(format!(
                    "the numbers end before line {number}, \"{short}\": it and what follows are not used"
                ));
                break;
            }
        }
    }
    Ok(profile)
}

/// Returns true if a line has numbers in both columns (counted from 1), perhaps with decimal commas.
fn begins_numbers(line: &str, columns: [usize; 2]) -> bool {
    // Where all lines are looked at, marks of thousands are refused.
    let with_points =
        file_text::with_points("profile", line).unwrap_or_else(|_| Some(line.replace(',', ".")));
    row_of_line(line, columns).is_ok()
        || with_points.is_some_and(|line| row_of_line(&line, columns).is_ok())
}

/// Refuses a header whose units are not those of the settings, and returns the unit of the positions that it states.
/// The header is the last line of text above the numbers, if it has as many words as there are columns.
fn check_header(
    above: &[&str],
    columns: usize,
    settings: &ProfileSettings,
) -> Result<Option<Unit>, Invalid> {
    let Some(i) = above.iter().rposition(|line| !line.trim().is_empty()) else { return Ok(None) };
    let line = above[i];
    let number = i + 1;
    // The files of the long-trace profiler of the ESRF have slopes in mrad, which they do not state.
    let milliradian = Unit::read("mrad", &[]);
    if line.trim_start().starts_with("Slopes_") && Some(settings.value_unit) != milliradian {
        let problem = format!(
            "is {}, but line {number} begins the slopes of an .slp2 file, which are in mrad",
            settings.value_unit
        );
        let remedy =
            format!("give `value_unit` mrad, or `header_lines` {number} where they are not");
        return Err(Invalid::whole("value_unit", problem, remedy));
    }
    let plain = line.trim_start_matches(['#', '%', '!', ' ']);
    let names: Vec<&str> = file_text::fields(plain).collect();
    if names.len() != columns {
        return Ok(None);
    }
    let [position, value] = settings.columns;
    // A name may have the first of these quantities, or the other.
    let value_quantities = match settings.value_unit.quantity() {
        Quantity::Angle => [Quantity::Angle, Quantity::Length],
        _ => [Quantity::Length, Quantity::Angle],
    };
    let mut position_unit = None;
    for (setting, column, unit, quantities) in [
        ("position_unit", position, settings.position_unit, &[Quantity::Length][..]),
        ("value_unit", value, Some(settings.value_unit), &value_quantities[..]),
    ] {
        let Some(name) = names.get(column - 1) else { continue };
        let otherwise = format!("`header_lines` {number} where the name is wrong");
        let header = Header::read(name, quantities)
            .map_err(|e| e.refused(setting, format!("correct the name, or give {otherwise}")))?;
        let Some(stated) = header.unit else { continue };
        if let Some(unit) = unit.filter(|unit| *unit != stated) {
            let short: String = name.chars().filter(|c| !c.is_control()).take(40).collect();
            let problem = format!("is {unit}, but line {number} names column {column} \"{short}\"");
            let remedy = format!("give `{setting}` {stated}, or {otherwise}");
            return Err(Invalid::whole(setting, problem, remedy));
        }
        if setting == "position_unit" {
            position_unit = Some(stated);
        }
    }
    Ok(position_unit)
}

/// Returns the position and the value of a line, or the words for the mistake in it. `columns` count from 1.
fn row_of_line(line: &str, columns: [usize; 2]) -> Result<[f64; 2], String> {
    let fields: Vec<&str> = file_text::fields(line.trim()).collect();
    let position = number_of_column(&fields, columns[0])?;
    let value = number_of_column(&fields, columns[1])?;
    if position.is_nan() {
        return Err("has no position".into());
    }
    Ok([position, value])
}

/// Returns the number in a column, counted from 1, or NaN for a mark of no data. The error is the words for the
/// mistake.
fn number_of_column(fields: &[&str], column: usize) -> Result<f64, String> {
    let field = fields
        .get(column - 1)
        .ok_or_else(|| format!("has {} column(s), not {column},", fields.len()))?;
    // Fortran writes 1.0D-3.
    let plain = field.replace(['d', 'D'], "e");
    match plain.parse::<f64>() {
        Ok(v) => Ok(v),
        Err(_) if !field.is_empty() && file_text::is_no_data(field) => Ok(f64::NAN),
        Err(_) => {
            let short: String = field.chars().filter(|c| !c.is_control()).take(20).collect();
            Err(format!("has \"{short}\" where a number should be"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unit(word: &str) -> Unit {
        Unit::read(word, &[]).unwrap()
    }

    fn settings(columns: [usize; 2], header_lines: Option<usize>) -> ProfileSettings {
        ProfileSettings { columns, position_unit: None, value_unit: unit("urad"), header_lines }
    }

    #[test]
    fn headers_delimiters_and_columns_of_the_instruments() {
        let want = vec![[0.0, 1.5], [1.0, -2e-3]];
        for (text, columns, header) in [
            ("0 1.5\n1 -2e-3\n", [1, 2], None),
            ("\u{feff}Mirror 12\nposition [mm], slope [urad]\n0, 1.5\n1, -2D-3\n\n", [1, 2], None),
            ("# comment\n1.5;7;0\n-0.002;8;1\r\n", [3, 1], None),
            ("20 7\n0\t1.5\n1\t-0.002", [1, 2], Some(1)),
        ] {
            let found = rows_of_text(text.as_bytes(), &settings(columns, header)).unwrap();
            assert_eq!(found.rows, want, "{text}");
        }
        let nan = rows_of_text(b"0 1\n1 NaN\n2 bad", &settings([1, 2], None)).unwrap().rows;
        assert!(nan[1][1].is_nan() && nan[2][1].is_nan());
    }

    #[test]
    fn the_units_of_names_are_those_of_the_settings() {
        let said = |text: &str, header| {
            let rows = rows_of_text(text.as_bytes(), &settings([1, 2], header));
            rows.err().map(|e| e.to_string()).unwrap_or_default()
        };
        // The settings are urad, and mm where the file does not state the unit of the positions.
        for names in
            ["x_mm,slope_urad", "# x [mm],slope (\u{b5}rad)", "x,y", "a b", "\"x (mm)\",\"s\""]
        {
            assert_eq!(said(&format!("{names}\n0,1\n1,2\n"), None), "", "{names}");
        }
        let metres =
            rows_of_text(b"title, of 3 m\nx_m,slope\n0,1\n", &settings([1, 2], None)).unwrap();
        assert_eq!(metres.position_unit, Some(unit("m")));
        let mm = ProfileSettings { position_unit: Some(unit("mm")), ..settings([1, 2], None) };
        let said_of_x =
            rows_of_text(b"title, of 3 m\nx_m,slope\n0,1\n", &mm).unwrap_err().to_string();
        assert!(said_of_x.contains("line 2 names column 1 \"x_m\""), "{said_of_x}");
        assert!(said_of_x.contains("give `position_unit` m"), "{said_of_x}");
        let unknown = said("x,slope (furlong)\n0,1\n", None);
        assert!(unknown.contains("\"furlong\" in \"slope (furlong)\""), "{unknown}");
        assert_eq!(said("x,slope (\")\n0,1\n", Some(1)), "");
        assert!(said("x;slope (arcsec)\n0;1\n", None).contains("give `value_unit` arcsec"));
        assert!(said("x;height (nm)\n0;1\n", None).contains("give `value_unit` nm"));
        assert_eq!(said("x;height (nm)\n0;1\n", Some(1)), "");
    }

    #[test]
    fn what_is_no_table_is_refused_with_line_value_and_remedy() {
        for (text, columns, part) in [
            ("0 1\nend of part\n1 2\n", [1, 2], "\"end\" where a number should be in line 2"),
            ("0 1\n1\n", [1, 2], "has 1 column(s), not 2, in line 2"),
            ("1,500;1,250\n", [1, 2], "marks of thousands"),
            ("", [1, 2], "`profile_columns`"),
            ("a\0b", [1, 2], "is not text"),
        ] {
            let e =
                rows_of_text(text.as_bytes(), &settings(columns, None)).unwrap_err().to_string();
            assert!(e.contains(part), "{e}");
        }
    }

    #[test]
    fn encodings_commas_quotes_and_lines_after_the_numbers() {
        let want = vec![[0.0, 1.5], [1.0, -2e-3], [2.0, 0.25]];
        let table = "x (mm)\tslope (\u{b5}rad)\n0\t1.5\n1\t-2e-3\n2\t0.25\n";
        let utf16: Vec<u8> =
            [0xFEFF].into_iter().chain(table.encode_utf16()).flat_map(u16::to_le_bytes).collect();
        let latin: Vec<u8> = table.chars().map(|c| u8::try_from(c).unwrap()).collect();
        let quoted =
            b"\"x (mm)\",\"slope (urad)\"\n\"0\",\"1.5\"\n\"1\",\"-2e-3\"\n\"2\",\"0.25\"\n";
        let commas = b"x (mm);slope (urad)\n0,0;1,5\n1,0;-2,0e-3\n2,0;0,25\n";
        for bytes in [&utf16[..], &latin, quoted, commas] {
            assert_eq!(rows_of_text(bytes, &settings([1, 2], None)).unwrap().rows, want);
        }
        let slp2 = "[header]\nfocal_length = \"0.6\"\nSlopes_Xmin = \"\n0 1.5\n1 -2e-3\n2 0.25\n\"\n[end]\ngravity = \"no\"\n";
        let said = rows_of_text(slp2.as_bytes(), &settings([1, 2], None)).unwrap_err().to_string();
        assert!(
            said.contains("line 3 begins the slopes of an .slp2 file, which are in mrad"),
            "{said}"
        );
        let mrad = ProfileSettings { value_unit: unit("mrad"), ..settings([1, 2], None) };
        let found = rows_of_text(slp2.as_bytes(), &mrad).unwrap();
        assert_eq!(found.rows, want);
        assert!(found.warnings[0].contains("end before line 8, \"[end]\""), "{:?}", found.warnings);
    }

    #[test]
    fn units_become_mm_nm_and_nrad() {
        let rows: Vec<[f64; 2]> = (0..8).map(|i| [f64::from(i), 2.0]).collect();
        let rows = ProfileRows { rows, position_unit: None, warnings: Vec::new() };
        for (word, step) in [("nm", 1e-6), ("um", 1e-3), ("mm", 1.0), ("m", 1e3), ("in", 25.4)] {
            let s = ProfileSettings { position_unit: Some(unit(word)), ..settings([1, 2], None) };
            // Rounding of positions, which are scaled.
            assert!((Profile::from_rows(&rows, &s).unwrap().step_mm() / step - 1.0).abs() < 1e-12);
        }
        for (word, want) in
            [("um", Values::HeightNm(vec![2e3; 8])), ("mrad", Values::SlopeNrad(vec![2e6; 8]))]
        {
            let s = ProfileSettings { value_unit: unit(word), ..settings([1, 2], None) };
            assert_eq!(*Profile::from_rows(&rows, &s).unwrap().values(), want);
        }
        let s = ProfileSettings { value_unit: unit("arcsec"), ..settings([1, 2], None) };
        let profile = Profile::from_rows(&rows, &s).unwrap();
        // An arc second is 4.8481368 urad.
        let Values::SlopeNrad(v) = profile.values() else { panic!("{profile:?}") };
        // The number has 8 digits.
        assert!((v[0] / 9696.2736 - 1.0).abs() < 1e-7, "{}", v[0]);
    }

    #[test]
    fn positions_ascend_or_descend_and_uneven_ones_are_named() {
        let profile = |x: Vec<f64>| {
            let n = x.len();
            Profile::new(x, Values::HeightNm((0..n).map(|i| i as f64).collect()))
        };
        let up: Vec<f64> = (0..9).map(f64::from).collect();
        let down: Vec<f64> = up.iter().rev().copied().collect();
        let turned = profile(down).unwrap();
        assert_eq!(turned.position_mm(), up);
        assert_eq!(*turned.values(), Values::HeightNm(up.iter().rev().copied().collect()));
        assert_eq!(turned.uneven_steps_mm(), None);
        let mut uneven = up.clone();
        uneven[4] = 4.3;
        let [low, high] = profile(uneven).unwrap().uneven_steps_mm().unwrap();
        // Rounding of positions of 4 mm.
        assert!((low - 0.7).abs() < 1e-12 && (high - 1.3).abs() < 1e-12);
        let mut unsorted = up.clone();
        unsorted[4] = 2.5;
        let message = profile(unsorted).unwrap_err().to_string();
        assert!(message.contains("position[4]: 2.5 mm follows 3 mm; sort"), "{message}");
        let message = profile(up[..5].to_vec()).unwrap_err().to_string();
        assert!(message.contains("has 5 valid value(s); give at least 8"), "{message}");
        let mut far = up;
        far[8] = 1e9;
        let message = profile(far).unwrap_err().to_string();
        assert!(
            message.contains("position[8]: is 1000000000 mm")
                && message.contains("`position_unit`")
        );
    }
}
