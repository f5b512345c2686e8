//! A profile: heights or slopes along a line, as a long-trace profiler or an autocollimator measures them.
//!
//! A file of a profile is a table of numbers, one line per position. The lines before the first one with a
//! number in both columns are its header. Neither the columns nor the units are in such a file: the user
//! states them, and the unit of the values decides whether they are heights or slopes.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | x | `position_mm` | (n), ascending | mm |
//! | z | [`Values::HeightNm`] | (n), NaN = invalid | nm |
//! | z' | [`Values::SlopeNrad`] | (n), NaN = invalid | nrad |

use planish_types::Invalid;
use serde::Serialize;

/// Smallest number of positions with a value; fewer are refused. Larger: refuses short profiles. Smaller: a
/// spectrum of so few positions is meaningless.
pub const MIN_POSITIONS: usize = 8;

/// Largest departure of a step between positions from the mean step, relative to it, at which steps count
/// as equal. Larger: uneven positions are taken for even ones, and frequencies are wrong by as much.
/// Smaller: positions that are rounded in the file are interpolated.
const UNIFORMITY: f64 = 0.01;

/// Largest plausible magnitudes: positions in mm, heights in nm, slopes in nrad. A larger value is refused,
/// because its unit is wrong. Larger: accepts wrong units. Smaller: refuses unusual profiles. Chosen:
/// positions and heights as for maps, slopes of 1 rad.
const LARGEST_PLAUSIBLE: [(&str, f64); 3] = [("position", 1e7), ("height", 1e12), ("slope", 1e9)];

/// Words that instruments write for an absent value.
const NO_DATA: [&str; 5] = ["nan", "bad", "no data", "nodata", "n/a"];

/// Unit of a length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum LengthUnit {
    /// Nanometre.
    Nm,
    /// Micrometre.
    Um,
    /// Millimetre.
    Mm,
    /// Metre.
    M,
}

impl LengthUnit {
    fn mm(self) -> f64 {
        match self {
            Self::Nm => 1e-6,
            Self::Um => 1e-3,
            Self::Mm => 1.0,
            Self::M => 1e3,
        }
    }
}

/// Unit of the values: of a length, which are heights, or of an angle, which are slopes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ValueUnit {
    /// Heights in nm.
    Nm,
    /// Heights in um.
    Um,
    /// Heights in mm.
    Mm,
    /// Heights in m.
    M,
    /// Slopes in nrad.
    Nrad,
    /// Slopes in urad.
    Urad,
    /// Slopes in mrad.
    Mrad,
    /// Slopes in rad.
    Rad,
    /// Slopes in seconds of arc.
    Arcsec,
}

/// Columns and units of a profile in its file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ProfileSettings {
    /// Column of the positions and column of the values, from 1.
    pub columns: [usize; 2],
    /// Unit of the positions.
    pub position_unit: LengthUnit,
    /// Unit of the values.
    pub value_unit: ValueUnit,
    /// Lines before the numbers; `None` for all that have none in both columns.
    pub header_lines: Option<usize>,
}

/// Measured values of a profile.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Heights, nm.
    HeightNm(Vec<f64>),
    /// Slopes, nrad.
    SlopeNrad(Vec<f64>),
}

/// A measured line; see the module.
#[derive(Clone, Debug, PartialEq)]
pub struct Profile {
    position_mm: Vec<f64>,
    values: Values,
}

impl Profile {
    /// Checks the positions. They ascend, or descend, which reverses the line, and at least
    /// [`MIN_POSITIONS`] have a value.
    pub fn new(mut position_mm: Vec<f64>, mut values: Values) -> Result<Self, Invalid> {
        let (name, v) = match &mut values {
            Values::HeightNm(v) => ("height", v),
            Values::SlopeNrad(v) => ("slope", v),
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
        let beyond = |name: &str, v: f64| {
            let largest =
                LARGEST_PLAUSIBLE.iter().find(|(n, _)| *n == name).map_or(0.0, |(_, l)| *l);
            v.is_infinite() || v.abs() > largest
        };
        if let Some(i) = position_mm.iter().position(|x| x.is_nan() || beyond("position", *x)) {
            let problem = format!("is {} mm", position_mm[i]);
            let remedy = "give a finite number, and check `position_unit`";
            return Err(Invalid::at("position", i, problem, remedy));
        }
        if let Some(i) = v.iter().position(|v| beyond(name, *v)) {
            let problem = format!("is {} {}", v[i], if name == "slope" { "nrad" } else { "nm" });
            let remedy = "give a finite number, and check `value_unit`";
            return Err(Invalid::at(
                if name == "slope" { "slope" } else { "height" },
                i,
                problem,
                remedy,
            ));
        }
        if position_mm[position_mm.len() - 1] < position_mm[0] {
            position_mm.reverse();
            v.reverse();
        }
        if let Some(i) = (1..position_mm.len()).find(|i| position_mm[*i] <= position_mm[i - 1]) {
            let problem = format!("{} mm follows {} mm", position_mm[i], position_mm[i - 1]);
            let remedy = "sort the lines by position, and leave only one of equal ones";
            return Err(Invalid::at("position", i, problem, remedy));
        }
        Ok(Self { position_mm, values })
    }

    /// Makes a profile from the rows [position, value] of a file, in its units.
    pub fn from_rows(rows: &[[f64; 2]], settings: &ProfileSettings) -> Result<Self, Invalid> {
        let position_mm = rows.iter().map(|r| settings.position_unit.mm() * r[0]).collect();
        let times = |factor: f64| rows.iter().map(|r| factor * r[1]).collect::<Vec<f64>>();
        let values = match settings.value_unit {
            ValueUnit::Nm => Values::HeightNm(times(1.0)),
            ValueUnit::Um => Values::HeightNm(times(1e3)),
            ValueUnit::Mm => Values::HeightNm(times(1e6)),
            ValueUnit::M => Values::HeightNm(times(1e9)),
            ValueUnit::Nrad => Values::SlopeNrad(times(1.0)),
            ValueUnit::Urad => Values::SlopeNrad(times(1e3)),
            ValueUnit::Mrad => Values::SlopeNrad(times(1e6)),
            ValueUnit::Rad => Values::SlopeNrad(times(1e9)),
            ValueUnit::Arcsec => {
                Values::SlopeNrad(times(1e9 * std::f64::consts::PI / (180.0 * 3600.0)))
            }
        };
        Self::new(position_mm, values)
    }

    /// Positions (n), mm, ascending.
    pub fn position_mm(&self) -> &[f64] {
        &self.position_mm
    }

    /// Heights or slopes (n).
    pub fn values(&self) -> &Values {
        &self.values
    }

    /// The mean step, mm.
    pub fn step_mm(&self) -> f64 {
        let x = &self.position_mm;
        (x[x.len() - 1] - x[0]) / (x.len() - 1) as f64
    }

    /// Smallest and largest step, mm, if they differ by more than the rounding of a file.
    pub fn uneven_steps_mm(&self) -> Option<[f64; 2]> {
        let steps = self.position_mm.windows(2).map(|w| w[1] - w[0]);
        let [low, high] = steps.fold([f64::INFINITY, 0.0_f64], |[l, h], s| [l.min(s), h.max(s)]);
        let mean = self.step_mm();
        (mean - low > UNIFORMITY * mean || high - mean > UNIFORMITY * mean).then_some([low, high])
    }
}

/// [position, value] of every line of a text, in the units of the file. A unit that ends the name of a column, in the line
/// above the numbers, must be that of the settings.
pub fn rows_of_text(bytes: &[u8], settings: &ProfileSettings) -> Result<Vec<[f64; 2]>, Invalid> {
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    let text = match std::str::from_utf8(bytes) {
        Ok(text) if !text.contains('\0') => text,
        _ => {
            let remedy = "export it as a table of text, or save it with numpy.save as .npy";
            return Err(Invalid::whole("profile", "is not text", remedy));
        }
    };
    let mut rows = Vec::new();
    // The line above the numbers, with its number.
    let mut above: Option<(usize, &str)> = None;
    let skipped = settings.header_lines.unwrap_or(0);
    for (i, line) in text.lines().enumerate().skip(skipped) {
        let line = line.trim();
        if line.is_empty() || line.starts_with(['#', '%', '!', '"', '\'']) {
            above = if line.is_empty() { above } else { Some((i + 1, line)) };
            continue;
        }
        match row_of_line(line, settings.columns) {
            Ok(row) => {
                if let (true, None, Some((number, names))) =
                    (rows.is_empty(), settings.header_lines, above)
                {
                    check_names(names, number, fields(line).len(), settings)?;
                }
                rows.push(row);
            }
            // The header.
            Err(_) if rows.is_empty() && settings.header_lines.is_none() => {
                above = Some((i + 1, line));
            }
            Err(problem) => {
                let remedy = "write numbers with a decimal point; give the right `profile_columns` \
                              and `header_lines`";
                let problem = format!("{problem} in line {}", i + 1);
                return Err(Invalid::whole("profile", problem, remedy));
            }
        }
    }
    if rows.is_empty() {
        let [position, value] = settings.columns;
        let problem = format!("has no line with numbers in the columns {position} and {value}");
        let remedy = "give the right `profile_columns`, and write numbers without quotes and with a decimal point";
        return Err(Invalid::whole("profile", problem, remedy));
    }
    Ok(rows)
}

/// The fields of a line: by comma, semicolon or tab where there is one, else by white space.
fn fields(line: &str) -> Vec<&str> {
    match [';', '\t', ','].into_iter().find(|c| line.contains(*c)) {
        Some(separator) => line.split(separator).map(str::trim).collect(),
        None => line.split_whitespace().collect(),
    }
}

/// Units by the names that end those of columns.
const UNITS: [&str; 9] = ["nm", "um", "mm", "m", "nrad", "urad", "mrad", "rad", "arcsec"];

/// The unit at the end of the name of a column, after a bracket, `_` or `/`, or a word of its own: `x_mm`, `height [nm]`.
fn unit_of_name(name: &str) -> Option<&'static str> {
    let plain = name.trim_matches(['"', '\'', ' ']).replace(['\u{b5}', '\u{3bc}'], "u");
    let plain = plain.trim_end_matches([')', ']', ' ']);
    let at = plain.rfind(['(', '[', '_', '/', ' '])?;
    UNITS.into_iter().find(|unit| *unit == &plain[at + 1..])
}

/// Refuses names of columns, in line `number` above the numbers, whose units are not those of the settings. A line with
/// more or fewer words than the numbers have columns names nothing.
fn check_names(
    line: &str,
    number: usize,
    columns: usize,
    settings: &ProfileSettings,
) -> Result<(), Invalid> {
    let names = fields(line.trim_start_matches(['#', '%', '!', ' ']));
    if names.len() != columns {
        return Ok(());
    }
    let [position, value] = settings.columns;
    let asked = [
        ("position_unit", position, format!("{:?}", settings.position_unit)),
        ("value_unit", value, format!("{:?}", settings.value_unit)),
    ];
    for (setting, column, asked) in asked {
        let Some(name) = names.get(column - 1) else { continue };
        let asked = asked.to_lowercase();
        if let Some(stated) = unit_of_name(name).filter(|stated| *stated != asked) {
            let short: String = name.chars().filter(|c| !c.is_control()).take(40).collect();
            let problem =
                format!("is {asked}, but line {number} names column {column} \"{short}\"");
            let remedy = format!(
                "give `{setting}` {stated}, or `header_lines` {number} where the name is wrong"
            );
            return Err(Invalid::whole(setting, problem, remedy));
        }
    }
    Ok(())
}

/// The two numbers of a line, or what is wrong with it.
fn row_of_line(line: &str, columns: [usize; 2]) -> Result<[f64; 2], String> {
    let fields = fields(line);
    let number = |column: usize| {
        let field = fields
            .get(column - 1)
            .ok_or_else(|| format!("has {} column(s), not {column},", fields.len()))?;
        // Fortran writes 1.0D-3.
        let plain = field.replace(['d', 'D'], "e");
        match plain.parse::<f64>() {
            Ok(v) => Ok(v),
            Err(_) if NO_DATA.contains(&field.to_ascii_lowercase().as_str()) => Ok(f64::NAN),
            Err(_) => {
                let short: String = field.chars().filter(|c| !c.is_control()).take(20).collect();
                Err(format!("has \"{short}\" where a number should be"))
            }
        }
    };
    Ok([number(columns[0])?, number(columns[1])?])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(columns: [usize; 2], header_lines: Option<usize>) -> ProfileSettings {
        ProfileSettings {
            columns,
            position_unit: LengthUnit::Mm,
            value_unit: ValueUnit::Urad,
            header_lines,
        }
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
            assert_eq!(rows_of_text(text.as_bytes(), &settings(columns, header)).unwrap(), want);
        }
        let nan = rows_of_text(b"0 1\n1 NaN\n2 bad", &settings([1, 2], None)).unwrap();
        assert!(nan[1][1].is_nan() && nan[2][1].is_nan());
    }

    #[test]
    fn the_units_of_names_are_those_of_the_settings() {
        let said = |text: &str, header| {
            let rows = rows_of_text(text.as_bytes(), &settings([1, 2], header));
            rows.err().map(|e| e.to_string()).unwrap_or_default()
        };
        // The settings are mm and urad.
        for names in
            ["x_mm,slope_urad", "# x [mm],slope (\u{b5}rad)", "x,y", "a b", "\"x (mm)\",\"s\""]
        {
            assert_eq!(said(&format!("{names}\n0,1\n1,2\n"), None), "", "{names}");
        }
        let said_of_x = said("title, of 3 m\nx_m,slope\n0,1\n", None);
        assert!(said_of_x.contains("line 2 names column 1 \"x_m\""), "{said_of_x}");
        assert!(said_of_x.contains("give `position_unit` m"), "{said_of_x}");
        assert!(said("x;height (nm)\n0;1\n", None).contains("give `value_unit` nm"));
        assert_eq!(said("x;height (nm)\n0;1\n", Some(1)), "");
    }

    #[test]
    fn what_is_no_table_is_refused_with_line_value_and_remedy() {
        for (text, columns, part) in [
            ("0 1\n1 2\nend of file\n", [1, 2], "\"end\" where a number should be in line 3"),
            ("0 1\n1\n", [1, 2], "has 1 column(s), not 2, in line 2"),
            ("0,5;1,2\n", [1, 2], "no line with numbers in the columns 1 and 2"),
            ("", [1, 2], "`profile_columns`"),
            ("a\0b", [1, 2], "is not text"),
        ] {
            let e =
                rows_of_text(text.as_bytes(), &settings(columns, None)).unwrap_err().to_string();
            assert!(e.contains(part), "{e}");
        }
    }

    #[test]
    fn units_become_mm_nm_and_nrad() {
        let rows: Vec<[f64; 2]> = (0..8).map(|i| [f64::from(i), 2.0]).collect();
        for (position_unit, step) in [
            (LengthUnit::Nm, 1e-6),
            (LengthUnit::Um, 1e-3),
            (LengthUnit::Mm, 1.0),
            (LengthUnit::M, 1e3),
        ] {
            let s = ProfileSettings { position_unit, ..settings([1, 2], None) };
            // Rounding of positions, which are scaled.
            assert!((Profile::from_rows(&rows, &s).unwrap().step_mm() / step - 1.0).abs() < 1e-12);
        }
        for (value_unit, want) in [
            (ValueUnit::Um, Values::HeightNm(vec![2e3; 8])),
            (ValueUnit::Mrad, Values::SlopeNrad(vec![2e6; 8])),
        ] {
            let s = ProfileSettings { value_unit, ..settings([1, 2], None) };
            assert_eq!(*Profile::from_rows(&rows, &s).unwrap().values(), want);
        }
        let s = ProfileSettings { value_unit: ValueUnit::Arcsec, ..settings([1, 2], None) };
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
