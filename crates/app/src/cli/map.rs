//! Maps for their drawing: the statistics of all pixels, and means of blocks of pixels.

use std::{iter::repeat, path::Path};

use planish_app::{guard::MapName, refusal::Refusal};
use planish_handoff::Inputs;
use planish_types::{Grid, Pose, Removal, Surface, Tif, doubts};
use serde::Serialize;

use super::server::Server;

/// Largest number of values along the longer side of a drawing. Larger: more to send and to draw. Smaller: coarser
/// pictures on a wide screen.
const MOST_VALUES: usize = 700;

/// Places along an axis at which a tool that varies is drawn, as fractions of the side of the part. On a disk all nine
/// are on the part.
const PLACES: [f64; 3] = [1.0 / 6.0, 0.5, 5.0 / 6.0];

/// Description of a map, which stands before its values.
#[derive(Serialize)]
struct MapHead {
    /// Values along x and y that follow, row 0 at the smallest y.
    shape: [usize; 2],
    /// Pixels of the map along x and y.
    pixels: [usize; 2],
    /// Distance of the pixel centres, mm.
    pitch_mm: [f64; 2],
    /// Edges of the values, mm: x from, x to, y from, y to.
    edges_mm: [f64; 4],
    /// Value in the middle of the colours: the mean of heights, 0 for rates.
    centre: f64,
    /// Unit of the values.
    unit: &'static str,
    /// Numbers of the whole map, with their names and units.
    numbers: Vec<(&'static str, f64, &'static str)>,
    /// Doubt about the map; empty if there is none.
    doubt: String,
}

/// Returns a map as bytes: the length of its head (four bytes, the lowest first), the head as JSON, then the values as
/// 32-bit floats (the lowest byte first), row by row. NaN is an invalid pixel.
///
/// # Errors
/// Fails if the step has no map yet.
pub fn map_bytes(server: &Server, name: MapName) -> Result<Vec<u8>, Refusal> {
    let files = &server.files;
    match name {
        MapName::Part => surface(&files.inside("part/prepared")?),
        MapName::Tool => Ok(tool(&read_tool(server)?)),
        MapName::Places => {
            let part = read_surface(&files.inside("part/prepared")?)?;
            places(&read_tool(server)?, part.grid())
        }
        MapName::After => {
            let live = server.live();
            let after = live.session.after.as_ref().map(|step| step.choice.source.surface("after"));
            drop(live);
            let after = after.ok_or_else(|| Refusal::new(404, "there is no map after the run"))?;
            surface(&files.inside(&after)?)
        }
        MapName::Before => {
            let run = server.live().session.run.clone();
            if run.is_empty() {
                return Err(Refusal::new(404, "there is no run yet"));
            }
            surface(&files.inside(&format!("{run}/surface"))?)
        }
        MapName::Removal | MapName::Residual => {
            let plan = server.recommended(&server.live().session)?;
            removal(&files.inside(&format!("{plan}/removal"))?, name)
        }
    }
}

fn removal(dir: &Path, name: MapName) -> Result<Vec<u8>, Refusal> {
    let removal: Removal = Inputs::new().read("removal", dir).map_err(|e| unreadable(&e))?;
    let residual = removal.residual();
    if name == MapName::Residual {
        return Ok(heights(residual, None));
    }
    let map = Surface::new(*residual.grid(), removal.removal_nm().clone());
    Ok(heights(&map.map_err(|e| unreadable(&e))?, None))
}

fn read_surface(dir: &Path) -> Result<Surface, Refusal> {
    Inputs::new().read("surface", dir).map_err(|e| unreadable(&e))
}

fn surface(dir: &Path) -> Result<Vec<u8>, Refusal> {
    let map = read_surface(dir)?;
    let doubt = doubts::of_heights(&map);
    Ok(heights(&map, doubt))
}

/// Returns the bytes of a map of heights.
fn heights(map: &Surface, doubt: Option<String>) -> Vec<u8> {
    let statistics = map.statistics();
    let numbers = vec![
        ("RMS", statistics.rms, "nm"),
        ("RMS without the plane", map.detilted_rms_nm(), "nm"),
        ("PV", statistics.pv, "nm"),
        ("mean", statistics.mean, "nm"),
        ("valid pixels", statistics.valid_count as f64, ""),
    ];
    drawing(map.grid(), map.height_nm().iter(), (statistics.mean, "nm"), numbers, doubt)
}

/// Reads the tool of the session.
fn read_tool(server: &Server) -> Result<Tif, Refusal> {
    let dir = server.live().session.tool.as_ref().map(|step| step.choice.source.tif());
    let dir = dir.ok_or_else(|| Refusal::new(404, "there is no tool yet"))?;
    let read = Inputs::new().read_tool("tif", &server.files.inside(dir)?);
    read.map_err(|e| unreadable(&e))
}

/// Returns the bytes of a map of the part with the removal rate of a tool that varies, which stands at each of
/// [`PLACES`] in turn and points along x. A pixel has the largest of these rates.
fn places(tif: &Tif, part: &Grid) -> Result<Vec<u8>, Refusal> {
    let none = || Refusal::new(404, "the tool is the same everywhere");
    let variation = tif.variation().ok_or_else(none)?;
    let (ny, nx) = part.shape();
    let factor = variation.factor_on(part);
    let factors = factor.iter().flat_map(|factor| factor.iter().copied());
    let factors: Vec<f64> = factors.chain(repeat(1.0)).take(ny * nx).collect();
    let mut rates = vec![0.0_f64; ny * nx];
    let mut peaks = Vec::new();
    let [along_x, along_y] = [&part.x, &part.y].map(|axis| {
        let [low, high] = axis.edges_mm();
        PLACES.map(|fraction| low + fraction * (high - low))
    });
    for pose in along_y.iter().flat_map(|y| along_x.map(|x| Pose::along_x([x, *y]))) {
        let mut peak = 0.0_f64;
        for (i, largest) in rates.iter_mut().enumerate() {
            let pixel = [part.x.coordinate_mm(i % nx), part.y.coordinate_mm(i / nx)];
            let offset = [0, 1].map(|axis| pixel[axis] - pose.position_mm[axis]);
            if [0, 1].iter().all(|axis| tif.cell(*axis, offset[*axis]).is_some()) {
                let rate = factors[i] * tif.rate_of_tool_at(pose, offset);
                *largest = largest.max(rate);
                peak = peak.max(rate);
            }
        }
        peaks.push(peak);
    }
    let numbers = vec![
        ("smallest peak rate", peaks.iter().copied().fold(f64::INFINITY, f64::min), "nm/s"),
        ("largest peak rate", peaks.iter().copied().fold(0.0, f64::max), "nm/s"),
    ];
    Ok(drawing(part, rates.iter(), (0.0, "nm/s"), numbers, None))
}

/// Returns the bytes of a map of the tool; of the mean tool, if it varies.
fn tool(tif: &Tif) -> Vec<u8> {
    let numbers = vec![
        ("peak rate", tif.peak_nm_per_s(), "nm/s"),
        ("full width at half maximum", tif.half_maximum_width_mm(), "mm"),
        ("volumetric removal rate", tif.vrr_nm_mm2_per_s(), "nm mm^2/s"),
    ];
    let doubt = doubts::of_tif(tif);
    drawing(tif.grid(), tif.rate_nm_per_s().iter(), (0.0, "nm/s"), numbers, doubt)
}

/// Returns the refusal for something of the session that cannot be read.
pub fn unreadable(problem: &dyn std::fmt::Display) -> Refusal {
    Refusal::new(500, problem.to_string())
}

/// Returns the bytes of a map with the given values, row by row. `centre` is the value in the middle of the colours, and
/// `unit` that of the values.
fn drawing<'a>(
    grid: &Grid,
    mut values: impl Iterator<Item = &'a f64>,
    (centre, unit): (f64, &'static str),
    numbers: Vec<(&'static str, f64, &'static str)>,
    doubt: Option<String>,
) -> Vec<u8> {
    let (ny, nx) = grid.shape();
    let block = nx.max(ny).div_ceil(MOST_VALUES).max(1);
    let [columns, rows] = [nx, ny].map(|n| n.div_ceil(block));
    let mut sums = vec![(0.0, 0_u32); columns * rows];
    for row in 0..ny {
        let sums = &mut sums[row / block * columns..][..columns];
        for (column, value) in values.by_ref().take(nx).enumerate() {
            if value.is_finite() {
                let (sum, count) = &mut sums[column / block];
                *sum += value;
                *count += 1;
            }
        }
    }
    let [x, y] = [&grid.x, &grid.y].map(|axis| axis.edges_mm()[0]);
    let [dx, dy] = [&grid.x, &grid.y].map(|axis| axis.step_mm());
    let head = MapHead {
        shape: [columns, rows],
        pixels: [nx, ny],
        pitch_mm: [dx, dy],
        edges_mm: [x, x + dx * (columns * block) as f64, y, y + dy * (rows * block) as f64],
        centre,
        unit,
        numbers,
        doubt: doubt.unwrap_or_default(),
    };
    let head = serde_json::to_vec(&head).unwrap_or_default();
    let mut bytes = (head.len() as u32).to_le_bytes().to_vec();
    bytes.extend(head);
    for (sum, count) in sums {
        let mean = if count == 0 { f64::NAN } else { sum / f64::from(count) };
        bytes.extend((mean as f32).to_le_bytes());
    }
    bytes
}
