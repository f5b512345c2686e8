//! The choice of a map, its coordinates and its mask among the named arrays of a file that holds several.

use ndarray::Array2;
use planish_types::Invalid;

use crate::{
    Unit,
    reading::{Coordinates, Pick},
};

/// Names that optics groups use for the arrays [map, x, y]: first of a height map, then of a tool influence function.
pub(crate) const CUSTOMARY: [[&str; 3]; 2] = [["Z", "X", "Y"], ["Ztif", "Xtif", "Ytif"]];

/// Pairs of names [x, y] under which coordinates are looked for in the group of a map of any name.
pub(crate) const BESIDE: [[&str; 2]; 8] = [
    ["X", "Y"],
    ["x", "y"],
    ["x_mm", "y_mm"],
    ["X_mm", "Y_mm"],
    ["x_um", "y_um"],
    ["X_um", "Y_um"],
    ["x_m", "y_m"],
    ["X_m", "Y_m"],
];

/// Words that the name of an array has, in lower case, if it marks valid or invalid pixels.
const MARKS: [&str; 5] = ["mask", "valid", "bad", "flag", "quality"];

/// Name of an array in a file, and its shape (rows, columns).
pub(crate) type Named = (String, Vec<u64>);

/// Names and shapes of the arrays in a file.
#[derive(Debug, Default)]
pub(crate) struct Arrays {
    /// Arrays of real numbers, which may be a map or coordinates.
    pub numbers: Vec<Named>,
    /// Arrays of truth values, which may be masks but no heights.
    pub marks: Vec<Named>,
}

impl Arrays {
    /// Returns the shape of the array of real numbers called `name`, or `None` without one.
    fn shape(&self, name: &str) -> Option<&[u64]> {
        self.numbers.iter().find(|a| a.0 == name).map(|a| &a.1[..])
    }
}

/// Returns the part of an array's name after the last `/`, without its groups.
pub(crate) fn leaf(name: &str) -> &str {
    name.rsplit('/').next().unwrap_or(name)
}

/// Returns the part of an array's name before the name itself: its groups or structures, with the last `/` or `.`;
/// empty without them.
pub(crate) fn prefix(name: &str) -> &str {
    &name[..name.rfind(['/', '.']).map_or(0, |end| end + 1)]
}

/// Returns the names of the arrays to read. Names in `pick` have priority, then customary names that exist, then the
/// only map; coordinates of its size in its group are added. `file` is the subject of messages. Refuses only one of x
/// and y, several maps or none, and a possible mask that the user did not name.
pub(crate) fn choose(arrays: &Arrays, pick: &Pick, file: &'static str) -> Result<Pick, Invalid> {
    if pick.x.is_some() != pick.y.is_some() {
        return Err(Invalid::whole(file, "one of `x` and `y` was given", "give both or none"));
    }
    let mut chosen = pick.clone();
    if chosen.dataset.is_none() {
        chosen.dataset = Some(only_map(arrays, pick, file)?);
    }
    let map = chosen.dataset.clone().unwrap_or_default();
    if pick.mask.is_none() && pick.dataset.is_none() {
        refuse_marks(arrays, &map, file)?;
    }
    if chosen.x.is_none()
        && let Some([x, y]) = coordinates(arrays, &map, pick.is_tif)
    {
        chosen.x = Some(x);
        chosen.y = Some(y);
    }
    Ok(chosen)
}

/// Returns the name of the map if the user names none: the customary one, also within a group, or the only matrix that
/// is not the mask. Refuses a file with several maps or none.
fn only_map(arrays: &Arrays, pick: &Pick, file: &'static str) -> Result<String, Invalid> {
    let maps = arrays.numbers.iter().filter(|a| a.1.len() == 2 && a.1.iter().all(|n| *n > 1));
    let maps: Vec<&str> = maps.map(|a| a.0.as_str()).collect();
    let customary = CUSTOMARY[usize::from(pick.is_tif)][0];
    if arrays.numbers.iter().any(|a| a.0 == customary) {
        return Ok(customary.into());
    }
    let in_groups: Vec<&&str> =
        maps.iter().filter(|name| name[prefix(name).len()..] == *customary).collect();
    if let [only] = in_groups[..] {
        return Ok((*only).into());
    }
    let not_mask = maps.iter().find(|name| pick.mask.as_deref() != Some(**name));
    match (&maps[..], not_mask) {
        ([only], _) => Ok((*only).into()),
        ([], _) => {
            let remedy = "give a file with an array of two axes";
            Err(Invalid::whole(file, "holds no matrix of real numbers", remedy))
        }
        ([a, b], Some(map)) if [Some(*a), Some(*b)].contains(&pick.mask.as_deref()) => {
            Ok((*map).into())
        }
        (several, _) => {
            let listed: Vec<&str> = several.iter().copied().take(20).collect();
            let problem = format!("holds several matrices: {}", listed.join(", "));
            Err(Invalid::whole(file, problem, "choose one with `dataset`"))
        }
    }
}

/// Refuses a map if another array of its size may mark valid or invalid pixels, because the user has to say which of
/// them it marks.
fn refuse_marks(arrays: &Arrays, map: &str, file: &'static str) -> Result<(), Invalid> {
    let Some((_, shape)) = arrays.numbers.iter().find(|a| a.0 == map) else { return Ok(()) };
    let named = arrays.numbers.iter().filter(|a| {
        let own = leaf(&a.0).to_lowercase();
        a.0 != map && (own == "dq" || MARKS.iter().any(|word| own.contains(word)))
    });
    let Some((mask, _)) = arrays.marks.iter().chain(named).find(|a| a.1 == *shape) else {
        return Ok(());
    };
    let problem = format!("holds \"{mask}\", an array of the size of \"{map}\"");
    let remedy = format!(
        "give `mask` {mask} where it is not 0 at invalid pixels, or `dataset` {map} to leave it out; invert it first \
         where it is not 0 at valid ones"
    );
    Err(Invalid::whole(file, problem, remedy))
}

/// Returns the names of the coordinates [x, y] in the group of the map called `map`. Coordinates that belong to another
/// customary map are not taken. Pairs other than the customary one of this map must have the right shapes; without a
/// pair it returns `None`.
fn coordinates(arrays: &Arrays, map: &str, is_tif: bool) -> Option<[String; 2]> {
    let group = prefix(map);
    let customary = CUSTOMARY.iter().find(|[z, ..]| map[group.len()..] == **z);
    if let Some([_, x, y]) = customary {
        let names = [x, y].map(|name| format!("{group}{name}"));
        if names.iter().all(|name| arrays.shape(name).is_some()) {
            return Some(names);
        }
    }
    let shape = arrays.shape(map)?;
    let [_, x, y] = CUSTOMARY[usize::from(is_tif)];
    for pair in [[x, y]].into_iter().chain(BESIDE) {
        let mut owners = CUSTOMARY.iter().filter(|[_, x, y]| pair == [*x, *y]);
        let is_of_another = customary.is_some()
            && owners.any(|[z, ..]| arrays.shape(&format!("{group}{z}")).is_some());
        let names = pair.map(|name| format!("{group}{name}"));
        let [Some(x), Some(y)] = [arrays.shape(&names[0]), arrays.shape(&names[1])] else {
            continue;
        };
        if !is_of_another && are_coordinates(x, y, shape) {
            return Some(names);
        }
    }
    None
}

/// Returns true if arrays of the shapes `x` and `y` may be coordinates of a map of the shape `map`. Both have that
/// shape, or they have as many elements as its two lengths, in either order.
fn are_coordinates(x: &[u64], y: &[u64], map: &[u64]) -> bool {
    let mut counts =
        [x, y].map(|shape| shape.iter().try_fold(1u64, |n, size| n.checked_mul(*size)));
    let mut sizes = [map.first().copied(), map.last().copied()];
    counts.sort_unstable();
    sizes.sort_unstable();
    (x == map && y == map) || counts == sizes
}

/// Returns the `len` coordinates of an axis from a vector (of any length), or from a matrix that varies along the
/// columns (x, if `columns`) or along the rows (y) only. Refuses another matrix.
pub(crate) fn along(
    name: &'static str,
    values: &Array2<f64>,
    len: usize,
    columns: bool,
) -> Result<Vec<f64>, Invalid> {
    let (r, c) = values.dim();
    if r == 1 || c == 1 {
        return Ok(values.iter().copied().collect());
    }
    let line: Vec<f64> = if columns { values.row(0).to_vec() } else { values.column(0).to_vec() };
    let spread = line.iter().fold(0.0_f64, |m, v| m.max((v - line[0]).abs()));
    let same = values.indexed_iter().all(|((i, j), v)| {
        let expected = line[if columns { j } else { i }];
        // Rounding of a coordinate that was computed twice.
        (v - expected).abs() <= 1e-9 * spread || (v.is_nan() && expected.is_nan())
    });
    if line.len() != len || !same {
        let problem = format!("of shape ({r}, {c}) is not a grid of {len} coordinates");
        return Err(Invalid::whole(name, problem, "give a vector, or what meshgrid makes"));
    }
    Ok(line)
}

/// Returns the coordinates of the columns and rows of a map of the shape `(rows, columns)`. `x` and `y` are the arrays
/// that `pick` names; the unit comes from the end of their names. Refuses different units, and a matrix that is no
/// grid.
pub(crate) fn named_coordinates(
    pick: &Pick,
    x: &Array2<f64>,
    y: &Array2<f64>,
    (rows, columns): (usize, usize),
) -> Result<Coordinates, Invalid> {
    let [unit, unit_of_y] = [&pick.x, &pick.y].map(|name| {
        let name = name.as_deref().unwrap_or_default();
        Unit::of_name(&name[prefix(name).len()..]).ok().and_then(|(_, unit)| unit)
    });
    if unit != unit_of_y {
        let problem = format!("{:?} and {:?} are in two units", pick.x, pick.y);
        return Err(Invalid::whole("coordinates", problem, "give both the same unit"));
    }
    Ok(Coordinates { x: along("x", x, columns, true)?, y: along("y", y, rows, false)?, unit })
}

/// Returns true if x varies along the rows of the file and y along its columns, as MATLAB's `ndgrid` makes them. Such a
/// map must be transposed. `size` is (rows, columns). Vectors tell it by their lengths; for a square map they do not.
pub(crate) fn is_turned(x: &Array2<f64>, y: &Array2<f64>, size: (usize, usize)) -> bool {
    let (rows, columns) = size;
    if [x, y].iter().all(|a| a.nrows() == 1 || a.ncols() == 1) {
        return rows != columns && x.len() == rows && y.len() == columns;
    }
    let goes_along_rows = |a: &Array2<f64>| {
        a.rows().into_iter().all(|row| row.iter().all(|v| *v == row[0]))
            && a[[0, 0]] != a[[rows - 1, 0]]
    };
    x.dim() == size && y.dim() == size && goes_along_rows(x) && !goes_along_rows(y)
}

/// Returns an array, with rows and columns swapped if `is_turned`.
pub(crate) fn upright(values: Array2<f64>, is_turned: bool) -> Array2<f64> {
    if is_turned { values.reversed_axes().as_standard_layout().into_owned() } else { values }
}

/// Warning for a map that was transposed because of [`is_turned`].
pub(crate) const TURNED: &str = "x goes along the rows of the file: the map was transposed";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_has_its_own_coordinates_and_not_those_of_another() {
        let chosen = |names: &[&str], map: &str, is_tif: bool| {
            let numbers = names.iter().map(|n| (n.to_string(), vec![5, 5])).collect();
            let arrays = Arrays { numbers, marks: vec![] };
            coordinates(&arrays, map, is_tif).map(|[x, y]| format!("{x} {y}"))
        };
        let both = ["Z", "X", "Y", "Ztif", "Xtif", "Ytif"];
        for is_tif in [false, true] {
            assert_eq!(chosen(&both, "Ztif", is_tif).unwrap(), "Xtif Ytif");
            assert_eq!(chosen(&both, "Z", is_tif).unwrap(), "X Y");
            // X and Y are those of Z; without Z they may be those of Ztif.
            assert_eq!(chosen(&["Z", "X", "Y", "Ztif"], "Ztif", is_tif), None);
            assert_eq!(chosen(&["X", "Y", "Ztif"], "Ztif", is_tif).unwrap(), "X Y");
            let grouped = ["m.Z", "m.X", "m.Y", "m.Ztif", "m.Xtif", "m.Ytif", "X", "Y"];
            assert_eq!(chosen(&grouped, "m.Ztif", is_tif).unwrap(), "m.Xtif m.Ytif");
        }
        assert_eq!(chosen(&["height", "x", "y"], "height", false).unwrap(), "x y");
    }
}
