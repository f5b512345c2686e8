//! The paths and fixtures of the tables.

use std::fs;

use planish_fixture::{Fixture, Recipe, make};
use planish_testkit::workspace;
use planish_toolpath::{
    Construction, MazeSettings, MultiPitchSettings, RandomAdaptiveSettings, RasterSettings, Scan,
    SpiralSettings, Tree, maze, multi_pitch, multi_pitch::Links, random_adaptive, raster, spiral,
};
use planish_types::{Surface, Tif, ToolPath};

/// Pitch of the random path by a tree, mm. Larger: fewer dwell points. Smaller: more. Chosen: the path has
/// about the published number of dwell points, 2678.
const MESH_TREE_PITCH_MM: f64 = 1.13;
/// Pitch of the random path by a tour, mm; chosen like [`MESH_TREE_PITCH_MM`].
const TOUR_PITCH_MM: f64 = 1.17;

/// A path whose pitch follows the desired removal, with about as many points as the published ones.
pub fn random(desired: &Surface, construction: Construction, seed: u64) -> ToolPath {
    let (pitch_mm, rounding_passes) = match construction {
        Construction::MeshTree => (MESH_TREE_PITCH_MM, 1),
        Construction::Tour => (TOUR_PITCH_MM, 0),
    };
    let settings = RandomAdaptiveSettings {
        pitch_mm,
        overscan_mm: 5.0,
        step_mm: Some(pitch_mm),
        contrast: 1.0,
        construction,
        rounding_passes,
        seed,
    };
    random_adaptive(desired, &settings).expect("a path").path
}

/// A maze of the pitch of the published one.
pub fn own_maze(desired: &Surface) -> ToolPath {
    let settings = MazeSettings {
        pitch_mm: 1.0,
        step_mm: 1.0,
        overscan_mm: 5.0,
        corner_radius_mm: 0.0,
        tree: Tree::DepthFirst { straightness: 0.0 },
        open: false,
        seed: 1,
    };
    maze(desired, &settings).expect("a path").path
}

/// A recipe in `fixtures/`, with or without its noise.
pub fn fixture(name: &str, noise: bool) -> Fixture {
    let file = workspace().join("fixtures").join(format!("{name}.json"));
    let text = fs::read_to_string(file).expect("the recipe is in fixtures/");
    let mut recipe: Recipe = serde_json::from_str(&text).expect("a recipe");
    if !noise {
        recipe.noise_rms_nm = 0.0;
    }
    make(&recipe).expect("a fixture")
}

/// Lines `pitch_mm` apart; between two lines the tool leaves the part.
pub fn lines(desired: &Surface, tif: &Tif, pitch_mm: f64, scan: Scan) -> ToolPath {
    let [x, y] = tif.half_size_mm();
    let settings = RasterSettings { scan, ..RasterSettings::new(pitch_mm, pitch_mm, x.max(y)) };
    raster(desired, &settings).expect("a path")
}

/// A spiral with turns `pitch_mm` apart, which the tool leaves the part on.
pub fn turns(desired: &Surface, tif: &Tif, pitch_mm: f64) -> ToolPath {
    let [x, y] = tif.half_size_mm();
    let settings = SpiralSettings { pitch_mm, step_mm: pitch_mm, overscan_mm: x.max(y) };
    spiral(desired, &settings).expect("a path")
}

/// A multi-pitch raster as `just paths-table` has it.
pub fn pitches(desired: &Surface, tif: &Tif) -> ToolPath {
    let settings = MultiPitchSettings {
        classes: 4,
        max_velocity_mm_per_s: 6.0,
        min_pitch_mm: 0.2,
        max_pitch_mm: 1.6,
        min_area_mm2: None,
        step_mm: 1.0,
        overscan_mm: 5.0,
        links: Links::Outside,
    };
    multi_pitch(desired, tif, &settings).expect("a path").path
}
