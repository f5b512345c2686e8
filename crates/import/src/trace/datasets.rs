//! HDF5: a dataset per quantity, or the columns of one.
//!
//! A dataset is named by its path, a column of a matrix by `PATH:K`, counted from 1. Its unit is the attribute
//! `unit` or `units`, where there is one.

use planish_types::Invalid;

use super::{
    NAME,
    columns::{Column, Columns, Named, Role, short, unit_named},
    table::most_samples,
};
use crate::{budget::too_many, hdf5};

/// Reads the datasets that are asked for.
pub fn read(bytes: &[u8], asked: &Columns) -> Result<Vec<Column>, Invalid> {
    let file = hdf5::open(bytes)?;
    let transposed = bytes.starts_with(b"MATLAB 7.3");
    let mut columns: Vec<Column> = Vec::new();
    for role in Role::ALL {
        let Some(name) = asked.of(role) else {
            if matches!(role, Role::X | Role::Y) {
                let setting = role.setting();
                let problem = format!("has no dataset that is known as {setting}");
                let remedy = format!(
                    "give `{setting}`, the path of a dataset, or PATH:K for column K of one"
                );
                return Err(Invalid::whole(NAME, problem, remedy));
            }
            continue;
        };
        let column = column(&file, role, name, transposed)?;
        if let Some(first) = columns.first()
            && first.values.len() != column.values.len()
        {
            let problem = format!(
                "{} has {} samples, {} has {}",
                short(&first.name),
                first.values.len(),
                short(name),
                column.values.len()
            );
            return Err(Invalid::whole(NAME, problem, "give datasets of the same length"));
        }
        columns.push(column);
    }
    if asked.setpoint_x.is_some() != asked.setpoint_y.is_some() {
        let problem = "was asked for the setpoint of one axis";
        return Err(Invalid::whole(NAME, problem, "give `setpoint_x` and `setpoint_y`"));
    }
    Ok(columns)
}

fn column(
    file: &hdf5_reader::Hdf5File,
    role: Role,
    name: &str,
    transposed: bool,
) -> Result<Column, Invalid> {
    let (path, which) = match name.rsplit_once(':') {
        Some((path, number)) => (path, Some(number)),
        None => (name, None),
    };
    let set = file.dataset(path).map_err(hdf5::broken)?;
    let matrix = hdf5::matrix(&set, transposed)?;
    let (rows, columns) = matrix.dim();
    let values: Vec<f64> = match which.map(str::parse::<usize>) {
        None if rows == 1 || columns == 1 => matrix.iter().copied().collect(),
        Some(Ok(k)) if (1..=columns).contains(&k) => matrix.column(k - 1).to_vec(),
        _ => {
            let problem = format!("is {}, of {rows} rows x {columns} columns", short(name));
            return Err(Invalid::whole(role.setting(), problem, "give PATH:K for column K of it"));
        }
    };
    if values.len() > most_samples() {
        return Err(too_many(NAME, most_samples(), "samples", "cut it"));
    }
    if let Some(i) = values.iter().position(|v| !v.is_finite()) {
        let problem = format!("is {} in {}", values[i], short(name));
        return Err(Invalid::at(role.setting(), i, problem, "cut the log where it is damaged"));
    }
    let unit = hdf5::unit_text(&set)?;
    let named = unit.as_deref().and_then(unit_named);
    Ok(Column {
        role,
        name: name.to_string(),
        position_unit: match named {
            Some(Named::Position(unit)) => Some(unit),
            _ => None,
        },
        time_unit: match named {
            Some(Named::Time(unit)) => Some(unit),
            _ => None,
        },
        values,
    })
}
