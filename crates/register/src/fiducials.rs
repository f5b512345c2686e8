//! Fiducials: points that are measured both in the map and on the machine.
//!
//! A CSV file has one line per fiducial, and a header in any order of `map_x_mm, map_y_mm, machine_x_mm,
//! machine_y_mm`. Optional columns are `name`, `uncertainty_mm` (standard deviation of the machine's coordinates, per
//! axis) and `map_uncertainty_mm`. A name may have another unit of length, as `map_x (um)`. A JSON file is a list of
//! objects with `map_mm: [x, y]`, `machine_mm: [x, y]` and the same optional keys. Lines of the CSV that begin with `#`
//! are comments.

use planish_types::{
    Invalid, file_text, is_plausible_mm,
    units::{Header, Quantity},
};
use serde::{Deserialize, Serialize};

/// Subject of the messages of this module.
const NAME: &str = "fiducial";

/// Largest number of fiducials that a file may hold; more are refused. Larger: more memory and time for a
/// file that is no list of fiducials. Smaller: a real list might be refused. Chosen: far more than anybody
/// measures.
const MOST_FIDUCIALS: usize = 100_000;

/// A point that was measured both in the map and on the machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fiducial {
    /// Name of the fiducial; its number, counted from 1, if the file gives none.
    #[serde(default)]
    pub name: String,
    /// Measured position of the fiducial in the coordinates of the map [x, y], mm.
    pub map_mm: [f64; 2],
    /// Measured position of the fiducial in the coordinates of the machine [x, y], mm.
    pub machine_mm: [f64; 2],
    /// Standard deviation of each machine coordinate, mm. If no fiducial states one, the fit estimates it from the
    /// residuals.
    #[serde(default)]
    pub uncertainty_mm: Option<f64>,
    /// Standard deviation of each map coordinate, mm; `None` counts as 0. The fit adds it in quadrature to that of the
    /// machine.
    #[serde(default)]
    pub map_uncertainty_mm: Option<f64>,
}

/// Reads fiducials from JSON, where the text begins with `[`, or CSV.
///
/// # Errors
/// Refuses text that is neither, unknown or repeated columns, coordinates that are not finite or above 1e7 mm, and
/// standard deviations that are not positive.
pub fn read(bytes: &[u8]) -> Result<Vec<Fiducial>, Invalid> {
    let text = file_text::text(NAME, bytes)?;
    let text = text.trim_start();
    let mut fiducials: Vec<Fiducial> = if text.starts_with('[') {
        serde_json::from_str(text).map_err(|e| {
            let remedy = "give a list of objects with map_mm, machine_mm and uncertainty_mm";
            Invalid::whole(NAME, format!("cannot be read ({e})"), remedy)
        })?
    } else {
        csv(text)?
    };
    if fiducials.len() > MOST_FIDUCIALS {
        let problem = format!("is one of {}", fiducials.len());
        return Err(Invalid::whole(NAME, problem, format!("give at most {MOST_FIDUCIALS}")));
    }
    for (i, fiducial) in fiducials.iter_mut().enumerate() {
        if fiducial.name.is_empty() {
            fiducial.name = format!("{}", i + 1);
        }
        for (name, point) in [("map_mm", fiducial.map_mm), ("machine_mm", fiducial.machine_mm)] {
            if !point.iter().all(|v| is_plausible_mm(*v)) {
                let remedy = "give finite coordinates in mm, within 1e7 mm of the origin";
                return Err(Invalid::at_index(name, i, format!("is {point:?}"), remedy));
            }
        }
        let uncertainties = [
            ("uncertainty_mm", fiducial.uncertainty_mm, false),
            ("map_uncertainty_mm", fiducial.map_uncertainty_mm, true),
        ];
        for (name, value, may_be_0) in uncertainties {
            let wrong = value.filter(|v| !v.is_finite() || *v < 0.0 || (*v == 0.0 && !may_be_0));
            if let Some(v) = wrong {
                let remedy = "give a positive standard deviation in mm, or leave it out for all";
                return Err(Invalid::at_index(name, i, format!("is {v}"), remedy));
            }
        }
    }
    Ok(fiducials)
}

/// Names of the columns of numbers in a CSV file, without the unit that follows each name.
const COLUMNS: [&str; 6] =
    ["map_x", "map_y", "machine_x", "machine_y", "uncertainty", "map_uncertainty"];

/// A column of a CSV file: its name without the unit, and the size of its unit in mm.
struct Column {
    name: &'static str,
    mm: f64,
}

/// Reads the heading of a column; returns `None` for the column `name`. Refuses an unknown column, and one without a
/// unit of length.
fn column(text: &str) -> Result<Option<Column>, Invalid> {
    let shown: String = text.chars().filter(|c| !c.is_control()).take(40).collect();
    let all: Vec<String> = COLUMNS.iter().map(|name| format!("{name}_mm")).collect();
    let all = format!("give name, {}", all.join(", "));
    if text.eq_ignore_ascii_case("name") {
        return Ok(None);
    }
    let header =
        Header::read(text, &[Quantity::Length]).map_err(|e| e.refused(NAME, all.clone()))?;
    let plain = header.name.trim().to_lowercase().replace([' ', '-'], "_");
    let Some(name) = COLUMNS.into_iter().find(|name| *name == plain) else {
        let problem = format!("has the column \"{shown}\", unknown or twice");
        return Err(Invalid::whole(NAME, problem, all));
    };
    match header.unit {
        Some(unit) if unit.quantity() == Quantity::Length => {
            Ok(Some(Column { name, mm: unit.size(-3) }))
        }
        Some(unit) => {
            let problem = format!("has the column \"{shown}\" in {unit}, which is no length");
            Err(Invalid::whole(NAME, problem, all))
        }
        None => {
            let problem = format!("has the column \"{shown}\" without a unit");
            Err(Invalid::whole(NAME, problem, format!("write {name}_mm, or another unit")))
        }
    }
}

/// Reads fiducials from the text of a CSV file. Lines that are empty or begin with `#` are skipped.
fn csv(text: &str) -> Result<Vec<Fiducial>, Invalid> {
    // Lines with their numbers, from 1.
    let lines = text.lines().enumerate().map(|(i, line)| (i + 1, line.trim()));
    let mut lines: Vec<(usize, String)> = lines
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
        .map(|(i, line)| (i, line.to_string()))
        .collect();
    if lines.is_empty() {
        let all = "give a header: map_x_mm, map_y_mm, machine_x_mm, machine_y_mm";
        return Err(Invalid::whole(NAME, "is not in the file", all));
    }
    let (_, header) = lines.remove(0);
    let names: Vec<&str> = file_text::fields(&header).collect();
    let columns = names.iter().map(|name| column(name)).collect::<Result<Vec<_>, _>>()?;
    let find = |name: &str| {
        columns.iter().position(|c| c.as_ref().map_or(name == "name", |c| c.name == name))
    };
    for (i, column) in columns.iter().enumerate() {
        let name = column.as_ref().map_or("name", |column| column.name);
        if find(name) != Some(i) {
            let problem = format!("has the column \"{}\", unknown or twice", names[i]);
            return Err(Invalid::whole(NAME, problem, "give every column once"));
        }
    }
    // Decimal commas are those of all lines together; a name may have a point.
    let numbers: Vec<String> = lines.iter().map(|(_, line)| line.clone()).collect();
    if header.contains([';', '\t'])
        && let Some(converted) = file_text::with_points(NAME, &numbers.join("\n"))?
    {
        for ((_, line), converted) in lines.iter_mut().zip(converted.lines()) {
            *line = converted.to_string();
        }
    }
    let mut fiducials = Vec::new();
    for (number, line) in &lines {
        let number = *number;
        let fields = fields_of(line, names.len());
        if fields.len() != names.len() {
            let problem = format!("has {} fields, the header {}", fields.len(), names.len());
            return Err(Invalid::at_index("line", number, problem, "give every column a field"));
        }
        let optional = |name: &str| -> Result<Option<f64>, Invalid> {
            let Some((i, column)) = find(name).and_then(|i| Some((i, columns[i].as_ref()?))) else {
                return Ok(None);
            };
            if fields[i].is_empty() {
                return Ok(None);
            }
            fields[i].parse().map(|v: f64| Some(v * column.mm)).map_err(|_| {
                let shown: String =
                    fields[i].chars().filter(|c| !c.is_control()).take(40).collect();
                let problem = format!("has \"{shown}\" as {}", names[i]);
                Invalid::at_index("line", number, problem, "give a number with a decimal point")
            })
        };
        let needed = |name: &'static str| {
            optional(name)?.ok_or_else(|| {
                Invalid::at_index(
                    "line",
                    number,
                    format!("has no {name}_mm"),
                    "give all coordinates",
                )
            })
        };
        fiducials.push(Fiducial {
            name: find("name").map_or(String::new(), |i| fields[i].to_string()),
            map_mm: [needed("map_x")?, needed("map_y")?],
            machine_mm: [needed("machine_x")?, needed("machine_y")?],
            uncertainty_mm: optional("uncertainty")?,
            map_uncertainty_mm: optional("map_uncertainty")?,
        });
    }
    Ok(fiducials)
}

/// Splits a line into its fields, of which the header has `count`. If the line has one field less and ends with a
/// separator, an empty field is added.
fn fields_of(line: &str, count: usize) -> Vec<&str> {
    let mut fields: Vec<&str> = file_text::fields(line).collect();
    if fields.len() + 1 == count && file_text::is_closed(line) {
        fields.push("");
    }
    fields
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_fiducials_as_csv_and_json() {
        let csv = "# edges\nname,map_x_mm,map_y_mm,machine_x_mm,machine_y_mm,uncertainty_mm\n\
                   a,0,1,10,11,0.005\n,2,3,12,13,\n";
        let json = r#"[{"name": "a", "map_mm": [0, 1], "machine_mm": [10, 11], "uncertainty_mm": 0.005},
                       {"map_mm": [2, 3], "machine_mm": [12, 13]}]"#;
        let found = read(csv.as_bytes()).unwrap();
        assert_eq!(found, read(json.as_bytes()).unwrap());
        // The same in other dress: decimal commas, quotes, UTF-16, other units.
        let commas = "name;map_x (mm);map_y (mm);machine_x (cm);machine_y_mm;uncertainty_um\n\
                      a;0,0;1,0;1,0;11,0;5,0\n;2,0;3,0;1,2;13,0;\n";
        let utf16: Vec<u8> =
            [0xFEFF].into_iter().chain(commas.encode_utf16()).flat_map(u16::to_le_bytes).collect();
        let quoted = "\"name\",\"map_x_mm\",\"map_y_mm\",\"machine_x_mm\",\"machine_y_mm\",\"uncertainty_mm\"\n\
                      \"a\",\"0\",\"1\",\"10\",\"11\",\"0.005\"\n\"\",\"2\",\"3\",\"12\",\"13\",\"\"\n";
        for bytes in [commas.as_bytes(), &utf16, quoted.as_bytes()] {
            assert_eq!(read(bytes).unwrap(), found, "{}", String::from_utf8_lossy(bytes));
        }
        assert_eq!((found[1].name.as_str(), found[1].uncertainty_mm), ("2", None));
    }

    #[test]
    fn bad_files_are_refused_with_the_place() {
        let head = "map_x_mm,map_y_mm,machine_x_mm,machine_y_mm,uncertainty_mm\n";
        for (text, expected) in [
            ("".to_string(), "is not in the file"),
            ("x,y\n1,2\n".into(), "the column \"x\""),
            (head.replace("map_x_mm", "map_x"), "the column \"map_x\" without a unit"),
            (head.replace("map_x_mm", "map_x (deg)"), "in deg, which is no length"),
            (head.replace("map_x_mm", "map_x (furlong)"), "\"furlong\""),
            (format!("{head}1,2,3,4\n"), "line[2]: has 4 fields"),
            (format!("{head}1,2,,4,1\n"), "line[2]: has no machine_x_mm"),
            (format!("{head}1,2,a,4,1\n"), "line[2]: has \"a\" as machine_x_mm"),
            (format!("{head}1,2,3,4,0\n"), "uncertainty_mm[0]: is 0"),
            (format!("{head}1,2,inf,4,1\n"), "machine_mm[0]"),
            ("[{\"map_mm\": [1, 2]}]".into(), "cannot be read (missing field"),
        ] {
            let said = read(text.as_bytes()).unwrap_err().to_string();
            assert!(said.contains(expected), "{text}: {said}");
        }
    }
}
