//! Fiducials: points that are measured both in the map and on the machine.
//!
//! A CSV file has one line per fiducial, and a header in any order of `map_x_mm, map_y_mm, machine_x_mm,
//! machine_y_mm`. Optional columns are `name`, `uncertainty_mm` (standard deviation of the machine's
//! coordinates, per axis) and `map_uncertainty_mm`. A JSON file is a list of objects with `map_mm: [x, y]`,
//! `machine_mm: [x, y]` and the same optional keys. Lines of the CSV that begin with `#` are comments.

use planish_types::{Invalid, is_plausible_mm};
use serde::{Deserialize, Serialize};

/// Subject of the messages of this module.
const NAME: &str = "fiducial";

/// Largest number of fiducials that a file may hold; more are refused. Larger: more memory and time for a
/// file that is no list of fiducials. Smaller: a real list might be refused. Chosen: far more than anybody
/// measures.
pub const MOST_FIDUCIALS: usize = 100_000;

/// A point in the map and on the machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fiducial {
    /// Name of the fiducial; its number, counted from 1, if the file gives none.
    #[serde(default)]
    pub name: String,
    /// Place of the fiducial in the map [x, y], mm.
    pub map_mm: [f64; 2],
    /// Place of the fiducial on the machine [x, y], mm.
    pub machine_mm: [f64; 2],
    /// Standard deviation of each coordinate on the machine, mm.
    #[serde(default)]
    pub uncertainty_mm: Option<f64>,
    /// Standard deviation of each coordinate in the map, mm; 0 where it is absent.
    #[serde(default)]
    pub map_uncertainty_mm: Option<f64>,
}

/// Reads fiducials from JSON, where the text begins with `[`, or CSV.
pub fn read(text: &str) -> Result<Vec<Fiducial>, Invalid> {
    let text = text.trim_start_matches('\u{feff}').trim_start();
    let mut fiducials: Vec<Fiducial> = match text.starts_with('[') {
        true => serde_json::from_str(text).map_err(|e| {
            let remedy = "give a list of objects with map_mm, machine_mm and uncertainty_mm";
            Invalid::whole(NAME, format!("cannot be read ({e})"), remedy)
        })?,
        false => csv(text)?,
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
                return Err(Invalid::at(name, i, format!("is {point:?}"), remedy));
            }
        }
        let uncertainties = [
            ("uncertainty_mm", fiducial.uncertainty_mm, false),
            ("map_uncertainty_mm", fiducial.map_uncertainty_mm, true),
        ];
        for (name, value, zero) in uncertainties {
            let valid = |v: f64| v.is_finite() && (v > 0.0 || (zero && v == 0.0));
            if let Some(v) = value.filter(|v| !valid(*v)) {
                let remedy = "give a positive standard deviation in mm, or leave it out for all";
                return Err(Invalid::at(name, i, format!("is {v}"), remedy));
            }
        }
    }
    Ok(fiducials)
}

/// Names of the columns of a CSV file.
const COLUMNS: [&str; 7] = [
    "name",
    "map_x_mm",
    "map_y_mm",
    "machine_x_mm",
    "machine_y_mm",
    "uncertainty_mm",
    "map_uncertainty_mm",
];

fn csv(text: &str) -> Result<Vec<Fiducial>, Invalid> {
    let lines = text.lines().enumerate().map(|(i, line)| (i + 1, line.trim()));
    let mut lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let separator = |line: &str| if line.contains(';') { ';' } else { ',' };
    let (_, header) = lines.next().ok_or_else(|| {
        Invalid::whole(NAME, "is not in the file", format!("give a header: {}", COLUMNS.join(", ")))
    })?;
    let names: Vec<&str> = header.split(separator(header)).map(str::trim).collect();
    let at = |name: &str| names.iter().position(|n| *n == name);
    for (i, name) in names.iter().enumerate() {
        if !COLUMNS.contains(name) || names[..i].contains(name) {
            let shown: String = name.chars().filter(|c| !c.is_control()).take(40).collect();
            let problem = format!("has the column \"{shown}\", unknown or twice");
            return Err(Invalid::whole(NAME, problem, format!("give {}", COLUMNS.join(", "))));
        }
    }
    let mut fiducials = Vec::new();
    for (number, line) in lines {
        let fields: Vec<&str> = line.split(separator(header)).map(str::trim).collect();
        if fields.len() != names.len() {
            let problem = format!("has {} fields, the header {}", fields.len(), names.len());
            return Err(Invalid::at("line", number, problem, "give every column a field"));
        }
        let optional = |name: &str| -> Result<Option<f64>, Invalid> {
            let Some(field) = at(name).map(|i| fields[i]).filter(|f| !f.is_empty()) else {
                return Ok(None);
            };
            field.parse().map(Some).map_err(|_| {
                let shown: String = field.chars().filter(|c| !c.is_control()).take(40).collect();
                let problem = format!("has \"{shown}\" as {name}");
                Invalid::at("line", number, problem, "give a number with a decimal point")
            })
        };
        let needed = |name: &'static str| {
            optional(name)?.ok_or_else(|| {
                Invalid::at("line", number, format!("has no {name}"), "give all coordinates")
            })
        };
        fiducials.push(Fiducial {
            name: at("name").map_or(String::new(), |i| fields[i].to_string()),
            map_mm: [needed("map_x_mm")?, needed("map_y_mm")?],
            machine_mm: [needed("machine_x_mm")?, needed("machine_y_mm")?],
            uncertainty_mm: optional("uncertainty_mm")?,
            map_uncertainty_mm: optional("map_uncertainty_mm")?,
        });
    }
    Ok(fiducials)
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
        let found = read(csv).unwrap();
        assert_eq!(found, read(json).unwrap());
        assert_eq!((found[1].name.as_str(), found[1].uncertainty_mm), ("2", None));
    }

    #[test]
    fn bad_files_are_refused_with_the_place() {
        let head = "map_x_mm,map_y_mm,machine_x_mm,machine_y_mm,uncertainty_mm\n";
        for (text, expected) in [
            ("".to_string(), "is not in the file"),
            ("x,y\n1,2\n".into(), "the column \"x\""),
            (format!("{head}1,2,3,4\n"), "line[2]: has 4 fields"),
            (format!("{head}1,2,,4,1\n"), "line[2]: has no machine_x_mm"),
            (format!("{head}1,2,a,4,1\n"), "line[2]: has \"a\" as machine_x_mm"),
            (format!("{head}1,2,3,4,0\n"), "uncertainty_mm[0]: is 0"),
            (format!("{head}1,2,inf,4,1\n"), "machine_mm[0]"),
            ("[{\"map_mm\": [1, 2]}]".into(), "cannot be read (missing field"),
        ] {
            let said = read(&text).unwrap_err().to_string();
            assert!(said.contains(expected), "{text}: {said}");
        }
    }
}
