//! Conversion of the types of `planish_types` (surface, TIF, path, motion ...) to stored arrays and back.

use std::path::Path;

use ndarray::{Array1, Array2, Array3, ArrayD, Axis as NdAxis, Ix1, Ix2, Ix3};
use planish_types::{
    AxesMotion, Axis, AzimuthWeights, DensityNodes, DwellDensity, DwellTime, Grid, Invalid,
    PixelFactor, Removal, RemovalMaps, Surface, Tif, TimeFactor, ToolPath, Trajectory, Transform,
    TurnWeights, VaryingTif, dwell_index_from_stored, outcome::tolerance::ToleranceArrays,
    stored_dwell_index,
};

use crate::{
    HandoffError,
    artifact::{self, Arrays, Artifact, Loaded, ManifestHead},
    kind::{self, Kind},
    npy::ArrayData,
};

fn axis_array<'a>(axis: &Axis) -> ArrayData<'a> {
    ArrayData::F64(Array1::from(axis.coordinates()).into_dyn().into())
}

fn map_array(map: &Array2<f64>) -> ArrayData<'_> {
    ArrayData::F64(map.as_standard_layout().into_dyn())
}

fn flags<'a>(values: &[bool]) -> ArrayData<'a> {
    ArrayData::U8(values.iter().map(|v| u8::from(*v)).collect::<Array1<u8>>().into_dyn().into())
}

fn integers<'a>(values: &[i64]) -> ArrayData<'a> {
    ArrayData::I64(Array1::from(values.to_vec()).into_dyn().into())
}

fn floats<'a>(values: &[f64]) -> ArrayData<'a> {
    ArrayData::F64(Array1::from(values.to_vec()).into_dyn().into())
}

fn points<'a>(values: &[[f64; 2]]) -> ArrayData<'a> {
    ArrayData::F64(Array2::from(values.to_vec()).into_dyn().into())
}

fn take_grid(arrays: &mut Arrays) -> Result<Grid, Invalid> {
    let mut axis = |name| Axis::from_coordinates(name, &take_vec(arrays.take_f64(name)));
    Ok(Grid { x: axis("x_mm")?, y: axis("y_mm")? })
}

fn take_map(arrays: &mut Arrays, name: &str) -> Array2<f64> {
    arrays.take_f64(name).into_dimensionality::<Ix2>().expect("the shape was checked")
}

fn take_vec<T>(array: ArrayD<T>) -> Vec<T> {
    let array = array.into_dimensionality::<Ix1>().expect("the shape was checked");
    array.into_raw_vec_and_offset().0
}

fn take_points(arrays: &mut Arrays, name: &str) -> Vec<[f64; 2]> {
    take_map(arrays, name).outer_iter().map(|p| [p[0], p[1]]).collect()
}

impl Artifact for Surface {
    const KIND: &'static Kind = &kind::SURFACE;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        let grid = self.grid();
        let mut arrays =
            vec![map_array(self.height_nm()), axis_array(&grid.x), axis_array(&grid.y)];
        arrays.extend(self.deviation_nm().map(map_array));
        arrays
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        let surface = Self::new(take_grid(&mut arrays)?, take_map(&mut arrays, "height_nm"))?;
        let deviation = take_map(&mut arrays, "deviation_nm");
        if deviation.is_empty() { Ok(surface) } else { surface.with_deviation(deviation) }
    }
}

impl Artifact for Tif {
    const KIND: &'static Kind = &kind::TIF;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        vec![
            map_array(self.rate_nm_per_s()),
            axis_array(&self.grid().x),
            axis_array(&self.grid().y),
        ]
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        Self::new(take_grid(&mut arrays)?, take_map(&mut arrays, "rate_nm_per_s"))
    }
}

/// Dependence of a varying tool on an angle: the angles, degrees, and for every kernel its factors at them.
type Turn = (Vec<f64>, Vec<Vec<f64>>);

/// Wrapper of a TIF that stores it as an artifact of the kind `tool`, which may vary over the part.
pub struct Tool(pub Tif);

impl Artifact for Tool {
    const KIND: &'static Kind = &kind::TOOL;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        let VaryingTif { offsets, kernels, positions, weights, azimuth, heading, pixels, time } =
            self.0.numbers();
        let turns = azimuth.is_some() || heading.is_some();
        let mut arrays = vec![
            stacked(&kernels),
            axis_array(&offsets.x),
            axis_array(&offsets.y),
            stacked(&weights),
            axis_array(&positions.x),
            axis_array(&positions.y),
        ];
        // Arrays may be absent at the end only. One time, pixels with the factor 1, and one azimuth with the factor 1 say
        // that there is no such factor.
        if time.is_some() || pixels.is_some() || turns {
            let none = TimeFactor { time_s: vec![0.0], factor: vec![1.0] };
            let TimeFactor { time_s, factor } = time.unwrap_or(none);
            arrays.extend([floats(&time_s), floats(&factor)]);
        }
        if pixels.is_some() || turns {
            let PixelFactor { grid, factor } = pixels.unwrap_or_else(|| PixelFactor {
                grid: positions,
                factor: Array2::ones(positions.shape()),
            });
            let factor = ArrayData::F64(factor.into_dyn().into());
            arrays.extend([factor, axis_array(&grid.x), axis_array(&grid.y)]);
        }
        if let Some(azimuth) = &azimuth {
            arrays.extend(turn_arrays(azimuth.turn()));
            arrays.push(floats(&azimuth.middle_mm()));
        } else if heading.is_some() {
            let ones = Array2::<f64>::ones((kernels.len(), 1));
            arrays.extend([ArrayData::F64(ones.into_dyn().into()), floats(&[0.0])]);
            arrays.push(floats(&[0.0, 0.0]));
        }
        arrays.extend(heading.iter().flat_map(turn_arrays));
        arrays
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        let mut axis = |name| Axis::from_coordinates(name, &take_vec(arrays.take_f64(name)));
        let offsets = Grid { x: axis("offset_x_mm")?, y: axis("offset_y_mm")? };
        let positions = take_grid(&mut arrays)?;
        let [kernels, weights] = ["rate_nm_per_s", "weight"].map(|name| {
            let stack = arrays.take_f64(name).into_dimensionality::<Ix3>();
            let stack = stack.expect("the shape was checked");
            stack.outer_iter().map(|map| map.to_owned()).collect::<Vec<_>>()
        });
        let time_s = take_vec(arrays.take_f64("time_s"));
        let time_factor = take_vec(arrays.take_f64("time_factor"));
        let is_one = time_factor.iter().all(|v| *v == 1.0);
        let time = if is_one { None } else { Some(TimeFactor { time_s, factor: time_factor }) };
        let factor = take_map(&mut arrays, "factor");
        let mut axis = |name| Axis::from_coordinates(name, &take_vec(arrays.take_f64(name)));
        let mut pixels = None;
        if !factor.iter().all(|v| *v == 1.0) {
            let grid = Grid { x: axis("factor_x_mm")?, y: axis("factor_y_mm")? };
            pixels = Some(PixelFactor { grid, factor });
        }
        let middle = take_vec(arrays.take_f64("azimuth_middle_mm"));
        let turn = take_turn(&mut arrays, "azimuth_weight", "azimuth_deg")?;
        let azimuth = match (turn, &middle[..]) {
            (None, _) => None,
            (Some((angles, rows)), [x, y]) => Some(AzimuthWeights::new([*x, *y], angles, rows)?),
            (Some(_), _) => {
                let remedy = "give the point about which the tool turns [x, y]";
                return Err(Invalid::whole("azimuth_middle_mm", "is missing", remedy));
            }
        };
        let heading = take_turn(&mut arrays, "heading_weight", "heading_deg")?;
        let heading = heading.map(|(angles, rows)| TurnWeights::by_heading(angles, rows));
        let heading = heading.transpose()?;
        let numbers =
            VaryingTif { offsets, kernels, positions, weights, azimuth, heading, pixels, time };
        Tif::varying(numbers).map(Self)
    }
}

/// Returns two arrays: the factors of every kernel (row) at every angle (column), and the angles, degrees.
fn turn_arrays<'a>(turn: &TurnWeights) -> [ArrayData<'a>; 2] {
    let rows = turn.weights();
    let weights = Array2::from_shape_fn((rows.len(), rows[0].len()), |(k, i)| rows[k][i]);
    [ArrayData::F64(weights.into_dyn().into()), floats(turn.angle_deg())]
}

/// Removes from the arrays the factors (`weights`) of the kernels by an angle of the tool, and the angles (`angles`),
/// which are names of arrays. Returns `None` if they are absent, or if there is one angle and all factors are 1.
/// Refuses angles without factors.
fn take_turn(
    arrays: &mut Arrays,
    weights: &'static str,
    angles: &'static str,
) -> Result<Option<Turn>, Invalid> {
    let rows = take_map(arrays, weights);
    let angle_deg = take_vec(arrays.take_f64(angles));
    if rows.is_empty() && !angle_deg.is_empty() {
        let problem = format!("is missing beside {angles}");
        return Err(Invalid::whole(weights, problem, "give both arrays"));
    }
    let is_one = rows.ncols() == 1 && rows.iter().all(|v| *v == 1.0);
    let rows = rows.outer_iter().map(|row| row.to_vec()).collect::<Vec<_>>();
    let is_absent = is_one || rows.iter().all(|row| row.is_empty());
    Ok(if is_absent { None } else { Some((angle_deg, rows)) })
}

/// Returns maps of one shape stacked along a new first axis.
fn stacked<'a>(maps: &[Array2<f64>]) -> ArrayData<'a> {
    let views: Vec<_> = maps.iter().map(|map| map.view()).collect();
    let stack = ndarray::stack(NdAxis(0), &views).expect("maps of one shape");
    ArrayData::F64(stack.into_dyn().into())
}

/// Reads a tool as [`artifact::read`] does, and returns its kind: a TIF, or one that varies over the part. The
/// manifest says which it is. Without a manifest, a directory with the array of weights holds a tool that varies.
pub(crate) fn read_tool(dir: &Path) -> Result<(&'static Kind, Loaded<Tif>), HandoffError> {
    artifact::read_whole(dir, || {
        artifact::check_directory(dir, Tif::KIND)?;
        let text = artifact::manifest_text(dir)?;
        let head = text.as_ref().and_then(|t| serde_json::from_str::<ManifestHead>(t).ok());
        let varies = match head {
            Some(head) => head.kind == Tool::KIND.name,
            None => dir.join("weight.npy").exists(),
        };
        if !varies {
            return Ok((Tif::KIND, artifact::read_arrays(dir, text.as_deref())?));
        }
        let Loaded { value: Tool(value), digest, manifest, warning } =
            artifact::read_arrays(dir, text.as_deref())?;
        Ok((Tool::KIND, Loaded { value, digest, manifest, warning }))
    })
}

impl Artifact for ToolPath {
    const KIND: &'static Kind = &kind::TOOL_PATH;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        vec![
            points(self.point_mm()),
            points(self.dwell_point_mm()),
            flags(self.tool_on()),
            integers(self.pass_idx()),
        ]
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        Self::new(
            take_points(&mut arrays, "point_mm"),
            take_points(&mut arrays, "dwell_point_mm"),
            arrays.take_bool("tool_on"),
            take_vec(arrays.take_i64("pass_idx")),
        )
    }
}

impl Artifact for DwellTime {
    const KIND: &'static Kind = &kind::DWELL;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        vec![floats(self.dwell_s())]
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        Self::new(take_vec(arrays.take_f64("dwell_s")))
    }
}

impl Artifact for DwellDensity {
    const KIND: &'static Kind = &kind::DWELL_DENSITY;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        vec![
            floats(self.arc_length_mm()),
            floats(self.dwell_density_s_per_mm()),
            points(self.point_mm()),
            integers(self.pass_idx()),
            flags(self.corner()),
        ]
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        Self::new(DensityNodes {
            arc_length_mm: take_vec(arrays.take_f64("arc_length_mm")),
            dwell_density_s_per_mm: take_vec(arrays.take_f64("dwell_density_s_per_mm")),
            point_mm: take_points(&mut arrays, "point_mm"),
            pass_idx: take_vec(arrays.take_i64("pass_idx")),
            corner: arrays.take_bool("corner"),
        })
    }
}

impl Artifact for Trajectory {
    const KIND: &'static Kind = &kind::TRAJECTORY;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        let coefficients = self.coefficient_mm();
        let c = Array3::from_shape_fn((self.len(), 2, 4), |(i, a, o)| coefficients[i][a][o]);
        let mut arrays = vec![
            floats(self.break_time_s()),
            ArrayData::F64(c.into_dyn().into()),
            flags(self.tool_on()),
            integers(
                &self.dwell_index().iter().copied().map(stored_dwell_index).collect::<Vec<_>>(),
            ),
        ];
        arrays.extend(self.rate_factor().map(floats));
        arrays
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        let c = arrays.take_f64("coefficient_mm");
        let segments =
            (0..c.shape()[0]).map(|i| [0, 1].map(|a| [0, 1, 2, 3].map(|o| c[[i, a, o]])));
        Self::new(
            take_vec(arrays.take_f64("break_time_s")),
            segments.collect(),
            arrays.take_bool("tool_on"),
            dwell_index_from_stored(&take_vec(arrays.take_i64("dwell_index")))?,
        )?
        .with_rate_factor(take_vec(arrays.take_f64("rate_factor")))
    }
}

impl Artifact for AxesMotion {
    const KIND: &'static Kind = &kind::AXES;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        let shape = (self.len(), self.axes(), 4);
        let c = Array3::from_shape_fn(shape, |(i, a, o)| self.segment(i)[a][o]);
        let index: Vec<i64> = self.dwell_index().iter().copied().map(stored_dwell_index).collect();
        vec![
            floats(self.break_time_s()),
            ArrayData::F64(c.into_dyn().into()),
            flags(self.tool_on()),
            integers(&index),
        ]
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        let c = arrays.take_f64("coefficient_mm_or_deg");
        let [k, n] = [c.shape()[0], c.shape()[1]];
        let cubics = (0..k).flat_map(|i| (0..n).map(move |a| (i, a)));
        Self::new(
            take_vec(arrays.take_f64("break_time_s")),
            cubics.map(|(i, a)| [0, 1, 2, 3].map(|o| c[[i, a, o]])).collect(),
            arrays.take_bool("tool_on"),
            dwell_index_from_stored(&take_vec(arrays.take_i64("dwell_index")))?,
        )
    }
}

impl Artifact for Transform {
    const KIND: &'static Kind = &kind::TRANSFORM;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        let rows =
            |rows: &[[f64; 6]]| ArrayData::F64(Array2::from(rows.to_vec()).into_dyn().into());
        vec![
            points(self.matrix()),
            floats(&self.centre_mm()),
            floats(&self.image_mm()),
            rows(self.covariance()),
        ]
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        let matrix = take_points(&mut arrays, "matrix");
        let [centre_mm, image_mm] = ["centre_mm", "image_mm"].map(|name| {
            let v = take_vec(arrays.take_f64(name));
            [v[0], v[1]]
        });
        let c = take_map(&mut arrays, "covariance_mm2");
        let covariance = std::array::from_fn(|i| std::array::from_fn(|j| c[[i, j]]));
        Self::new([matrix[0], matrix[1]], centre_mm, image_mm, covariance)
    }
}

impl Artifact for ToleranceArrays {
    const KIND: &'static Kind = &kind::TOLERANCE;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        vec![
            floats(&self.part),
            floats(&self.rms_nm),
            map_array(&self.deviation_nm),
            axis_array(&self.grid.x),
            axis_array(&self.grid.y),
        ]
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        Ok(Self {
            grid: take_grid(&mut arrays)?,
            part: take_vec(arrays.take_f64("part")),
            rms_nm: take_vec(arrays.take_f64("rms_nm")),
            deviation_nm: take_map(&mut arrays, "deviation_nm"),
        })
    }
}

impl Artifact for Removal {
    const KIND: &'static Kind = &kind::REMOVAL;

    fn to_arrays(&self) -> Vec<ArrayData<'_>> {
        let grid = self.residual().grid();
        vec![
            map_array(self.removal_nm()),
            map_array(self.residual().height_nm()),
            axis_array(&grid.x),
            axis_array(&grid.y),
        ]
    }

    fn from_arrays(mut arrays: Arrays) -> Result<Self, Invalid> {
        let grid = take_grid(&mut arrays)?;
        let removal_nm = take_map(&mut arrays, "removal_nm");
        let residual_nm = take_map(&mut arrays, "residual_nm");
        Removal::from_maps(grid, RemovalMaps { removal_nm, residual_nm })
    }
}
