//! One small file per case that a reader can get wrong, through the program: its command and its right value. All of
//! them hold the map of `truth.npy`, but for the two Zygo files.

use std::{fs, path::Path, process::Output};

use ndarray::Array2;
use planish_handoff::artifact::{self, Manifest};
use planish_types::{Surface, Trajectory};

const CASES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../import/tests/data/cases");

fn call(out: &Path, file: &str, flags: &[&str]) -> Output {
    planish_testkit::program::stage("planish-import")
        .current_dir(CASES)
        .args([&["surface", file, "--force", "--out", out.to_str().unwrap()][..], flags].concat())
        .output()
        .unwrap()
}

/// Reads a map with the program. Returns the map, its manifest, and the warnings.
fn read(file: &str, flags: &[&str]) -> (Surface, Manifest, String) {
    let tmp = tempfile::tempdir().unwrap();
    let out = tmp.path().join("out");
    let output = call(&out, file, flags);
    let warned = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{file} {flags:?}: {warned}");
    let loaded = artifact::read::<Surface>(&out).unwrap();
    (loaded.value, loaded.manifest.unwrap(), warned)
}

/// Runs the program on a file that it must refuse. Checks that nothing was written, and returns the message.
fn refused(file: &str, flags: &[&str]) -> String {
    let tmp = tempfile::tempdir().unwrap();
    let out = tmp.path().join("out");
    let output = call(&out, file, flags);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{file} {flags:?}: {said}");
    assert!(said.starts_with("error: ") && said.lines().count() == 1 && !out.exists(), "{said}");
    said
}

fn invalid(map: &Surface) -> usize {
    map.height_nm().iter().filter(|v| v.is_nan()).count()
}

/// Returns the map that most of the test files hold, nm (ny, nx). Row 0 is the smallest y.
fn truth() -> Array2<f64> {
    let bytes = fs::read(Path::new(CASES).join("truth.npy")).unwrap();
    planish_import::read(planish_import::Format::Npy, &bytes, &Default::default()).unwrap().values
}

/// Checks that `map` is that of [`truth`] on pixels of 0.5 mm, with every height within `tolerance_nm`. It must have
/// `invalid_pixels` invalid ones: 12, or 0 if the format cannot mark them and the file has heights there.
fn is_truth(map: &Surface, tolerance_nm: f64, invalid_pixels: usize) {
    let truth = truth();
    assert_eq!((map.height_nm().dim(), invalid(map)), (truth.dim(), invalid_pixels));
    let g = map.grid();
    // Pitches in the files have 6 digits or more.
    assert!((g.x.step_mm() / 0.5 - 1.0).abs() < 1e-6 && (g.y.step_mm() / 0.5 - 1.0).abs() < 1e-6);
    for ((at, found), right) in map.height_nm().indexed_iter().zip(&truth) {
        let same = (found - right).abs() <= tolerance_nm || right.is_nan();
        assert!(same, "pixel {at:?}: {found}, not {right}");
    }
}

/// Checks that the RMS of the map is `right_nm`, to four digits.
fn has_rms(map: &Surface, right_nm: f64) {
    let rms = map.statistics().rms;
    assert!((rms - right_nm).abs() < 5e-5, "{rms}, not {right_nm}");
}

#[test]
fn a_marker_is_compared_as_the_file_stores_it() {
    for (file, flags) in
        [("no-data.npy", &["--unit", "nm", "--pixel-mm", "0.5"][..]), ("no-data.fits", &[])]
    {
        let (map, _, warned) = read(file, &[flags, &["--no-data", "-999.9"]].concat());
        assert_eq!(invalid(&map), 158);
        has_rms(&map, 2.8724);
        assert!(warned.is_empty(), "{warned}");
        let (_, _, warned) = read(file, &[flags, &["--no-data", "-999.8"]].concat());
        let expected = "no pixel has the value -999.8: --no-data has no effect";
        assert!(warned.contains(expected) && warned.lines().count() == 2, "{warned}");
        assert!(warned.contains("158 pixels have the stored value -999.9"), "{warned}");
    }
}

#[test]
fn attributes_of_netcdf_are_obeyed() {
    let (map, manifest, _) = read("packed.h5", &["--pixel-mm", "0.5"]);
    has_rms(&map, 3.4807);
    let (low, high) =
        map.height_nm().iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    // Whole steps of 0.01 nm.
    assert!((low - 50.03).abs() < 1e-9 && (high - 65.0).abs() < 1e-9, "{low} {high}");
    let reading = &manifest.outcome["reading"];
    assert_eq!((&reading["nm_of_zero"], &reading["nm_per_value"]), (&50.0.into(), &0.01.into()));
    let (map, _, _) = read("fill.h5", &["--pixel-mm", "0.5"]);
    assert_eq!(invalid(&map), 12);
    has_rms(&map, 3.4794);
}

#[test]
fn a_mask_in_a_second_image_is_named_or_used() {
    let flags = ["--pixel-mm", "0.5"];
    let said = refused("mask.fits", &flags);
    assert!(said.contains("holds 2 images: HDU 0, HDU 1") && said.contains("--mask"), "{said}");
    let (map, _, _) = read("mask.fits", &[&flags[..], &["--dataset", "0", "--mask", "1"]].concat());
    assert_eq!(invalid(&map), 158);
    has_rms(&map, 2.8724);
    // The same image under its customary name needs no flag.
    let tmp = tempfile::tempdir().unwrap();
    let mut bytes = fs::read(Path::new(CASES).join("mask.fits")).unwrap();
    let end = bytes.windows(80).rposition(|card| card.starts_with(b"END  ")).unwrap();
    bytes[end..end + 160]
        .copy_from_slice(format!("{:<80}{:<80}", "EXTNAME = 'MASK'", "END").as_bytes());
    let named = tmp.path().join("named.fits");
    fs::write(&named, &bytes).unwrap();
    let (map, manifest, _) = read(named.to_str().unwrap(), &flags);
    assert_eq!(
        (invalid(&map), &manifest.outcome["reading"]["stated"]["mask_hdu"]),
        (158, &1.into())
    );
    let said = refused(named.to_str().unwrap(), &[&flags[..], &["--mask", "7"]].concat());
    assert!(said.contains("holds 2 images") || said.contains("no HDU 7"), "{said}");
    // A name that no format but these has is no silent flag.
    let said = refused("no-data.npy", &["--unit", "nm", "--pixel-mm", "0.5", "--mask", "m"]);
    assert!(said.contains("leave it out"), "{said}");
}

#[test]
fn axes_in_a_table_are_no_heights() {
    let (map, _, warned) = read("axes.csv", &["--unit", "nm", "--coordinate-unit", "mm"]);
    // 4 decimals of a nm.
    is_truth(&map, 5e-5, 0);
    assert!(warned.contains("are the coordinates x and y"), "{warned}");
    let said = refused("axes.csv", &["--unit", "nm", "--pixel-mm", "0.5"]);
    assert!(said.contains("coordinates with the steps 0.5 and 0.5"), "{said}");
    assert!(said.contains("give --coordinate-unit"), "{said}");
    // Axes with a number in the corner, and lines x y z, are no heights.
    let tmp = tempfile::tempdir().unwrap();
    let put = |name: &str, text: &str| {
        let path = tmp.path().join(name);
        fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_string()
    };
    let nm = ["--unit", "nm", "--pixel-mm", "1"];
    let text = fs::read_to_string(Path::new(CASES).join("axes.csv")).unwrap();
    let said = refused(&put("a.csv", &format!("0{text}")), &nm);
    assert!(said.contains("the first line and the first column go in equal steps"), "{said}");
    let (map, _, _) =
        read(&put("b.csv", &format!("y\\x{text}")), &["--unit", "nm", "--coordinate-unit", "mm"]);
    is_truth(&map, 5e-5, 0);
    let lines: String = (0..12).map(|i| format!("{},{},{i}\n", i % 4, i / 4)).collect();
    let said = refused(&put("c.csv", &lines), &nm);
    assert!(said.contains("12 lines of 3 numbers") && said.contains("--format xyz"), "{said}");
    // A word in the corner of a table without axes stays a mistake.
    let said = refused(&put("d.csv", "a,2,3\n4,5,6\n"), &nm);
    assert!(said.contains("\"a\" in line 1, field 1"), "{said}");
}

#[test]
fn a_header_of_text_is_believed_before_a_flag() {
    // 7 digits of a metre.
    let (map, manifest, _) = read("gwyddion.csv", &[]);
    is_truth(&map, 1e-5, 0);
    assert_eq!(manifest.outcome["reading"]["unit_from"], "file");
    let said = refused("gwyddion.csv", &["--unit", "nm"]);
    assert!(said.contains("is m in the file, nm was asked for"), "{said}");
    let said = refused("gwyddion.csv", &["--pixel-mm", "0.1"]);
    assert!(said.contains("0.5 x 0.5 mm in the file, 0.1 x 0.1 mm was asked for"), "{said}");
    let (map, _, warned) = read("gwyddion.csv", &["--pixel-mm", "0.1", "--override-file"]);
    assert_eq!(map.grid().x.step_mm(), 0.1);
    assert!(warned.contains("takes the place of 0.5 x 0.5 mm"), "{warned}");
    let spip = "# File Format = ASCII\n# x-pixels = 2\n# y-pixels = 2\n# x-length = 1000\n# y-length = 4000\n\
                # x-unit = nm\n# Bit2nm = 0.5\n# Start of Data:\n1 2\n3 4\n";
    let tmp = tempfile::tempdir().unwrap();
    let path = tmp.path().join("a.csv");
    fs::write(&path, spip).unwrap();
    let (map, _, _) = read(path.to_str().unwrap(), &[]);
    assert_eq!(map.height_nm().row(0).to_vec(), [1.5, 2.0]);
    // 1000 and 4000 nm over 2 pixels; the products round.
    assert!((map.grid().x.step_mm() - 5e-4).abs() < 1e-15);
    assert!((map.grid().y.step_mm() - 2e-3).abs() < 1e-15);
}

#[test]
fn pixels_are_counted_one_way_in_a_file() {
    let (relative, _, _) = read("relative.xyz", &["--unit", "um"]);
    let (camera, _, _) = read("camera.xyz", &["--unit", "um"]);
    assert_eq!(invalid(&relative), 0);
    has_rms(&relative, 576.7437);
    assert_eq!(relative.height_nm(), camera.height_nm());
    assert_eq!(relative.grid(), camera.grid());
    let text = fs::read_to_string(Path::new(CASES).join("camera.xyz")).unwrap();
    let tmp = tempfile::tempdir().unwrap();
    let said = |from: &str, to: &str| {
        let path = tmp.path().join("a.xyz");
        assert!(text.contains(from));
        fs::write(&path, text.replace(from, to)).unwrap();
        refused(path.to_str().unwrap(), &["--unit", "um"])
    };
    assert!(said("\n11 5 ", "\n10 5 ").contains("names the pixel 10 5 a second time"));
    assert!(
        said("\n10 5 0.0", "\n0 0 0.0").contains("neither all from 10 5 on nor all from 0 0 on")
    );
}

#[test]
fn a_flag_without_an_effect_says_so() {
    let flags = ["--unit", "nm", "--pixel-mm", "0.5", "--wavelength-nm", "632.8"];
    let (_, _, warned) = read("truth.npy", &flags);
    assert!(warned.contains("in nm: --wavelength-nm has no effect"), "{warned}");
}

#[test]
fn coordinates_and_masks_of_hdf5_are_used_or_named() {
    let (map, manifest, _) = read("axes.h5", &[]);
    // 32-bit floats of 65 nm.
    is_truth(&map, 65.0 * 6e-8, 12);
    assert_eq!(manifest.outcome["reading"]["pitch_from"], "file");
    let said = refused("axes.h5", &["--pixel-mm", "0.4"]);
    assert!(said.contains("[0.4, 0.4] was given, but the file has coordinates"), "{said}");
    let (map, _, warned) = read("axes.h5", &["--pixel-mm", "0.4", "--override-file"]);
    assert_eq!(map.grid().x.step_mm(), 0.4);
    assert!(warned.contains("takes the place of the coordinates"), "{warned}");

    let flags = ["--pixel-mm", "0.5"];
    let said = refused("mask.h5", &flags);
    assert!(said.contains("holds \"pixel_mask\"") && said.contains("--mask pixel_mask"), "{said}");
    let (map, _, _) = read("mask.h5", &[&flags[..], &["--mask", "pixel_mask"]].concat());
    is_truth(&map, 65.0 * 6e-8, 12);
    let (map, _, _) = read("mask.h5", &[&flags[..], &["--dataset", "Z"]].concat());
    assert_eq!(invalid(&map), 0);
}

#[test]
fn a_measurement_of_several_is_chosen() {
    let said = refused("4sight-two.h5", &[]);
    assert!(said.contains("holds 2 measurements: measurement0, measurement1"), "{said}");
    let first = ["--dataset", "measurement0/genraw/data"];
    let (map, _, _) = read("4sight-two.h5", &first);
    assert_eq!(map.height_nm()[[0, 0]], 0.25 * 632.8);
    // The pixels of the second are not square.
    let second = ["--dataset", "measurement1/genraw/data"];
    assert!(refused("4sight-two.h5", &second).contains("give --pixel-mm"));
    let (map, _, warned) = read("4sight-two.h5", &[&second[..], &["--pixel-mm", "0.5,1"]].concat());
    assert_eq!((map.height_nm()[[1, 2]], map.grid().y.step_mm()), (0.5 * 632.8, 1.0));
    assert!(warned.contains("not square (aspect 2)"), "{warned}");
}

/// Checks files that state unit and pitch: they need no flag, and a flag that contradicts them is refused.
#[test]
fn files_that_state_everything_need_no_flag() {
    // Each with the rounding of its numbers in nm, its invalid pixels, and the name of its format.
    for (file, tolerance_nm, invalid_pixels, format) in [
        // 32-bit floats of 65e-9 m.
        ("map.gsf", 65.0 * 6e-8, 12, "gsf"),
        // 64-bit floats, in m; the mask of the channel marks the invalid pixels.
        ("map.gwy", 1e-12, 12, "gwy"),
        // Ten digits of a millimetre.
        ("grid-sag.dat", 65.0 * 5e-10, 12, "grid-sag"),
        // 64-bit floats, in m.
        ("map.x3p", 1e-12, 12, "x3p"),
        // 32-bit floats of waves, and a wavelength that passed through one.
        ("map.opd", 65.0 * 12e-8, 12, "opd"),
        ("4sight.h5", 65.0 * 6e-8, 12, "4sight"),
    ] {
        let (map, manifest, _) = read(file, &[]);
        is_truth(&map, tolerance_nm, invalid_pixels);
        has_rms(&map, 3.4794);
        let reading = &manifest.outcome["reading"];
        assert_eq!((&reading["format"], &reading["pitch_from"]), (&format.into(), &"file".into()));
        assert_eq!(reading["unit_from"], "file");
        let said = refused(file, &["--unit", "angstrom"]);
        assert!(said.contains("in the file, angstrom was asked for"), "{said}");
        let said = refused(file, &["--pixel-mm", "0.4"]);
        assert!(said.contains("0.5") && said.contains("0.4"), "{said}");
    }
}

/// Checks a Gwyddion file with three channels. The first row is the top: the marked corner of channel 0 is the first
/// pixel of the file, which has the smallest x and the largest y.
#[test]
fn a_channel_of_a_gwyddion_file_is_chosen_by_its_number() {
    let said = refused("two.gwy", &[]);
    assert!(said.contains("holds 3 channels: 0 (Height), 3, 4 (Phase)"), "{said}");
    let corners = |channel: &str| {
        let (map, ..) = read("two.gwy", &["--dataset", channel]);
        let z = map.height_nm();
        assert_eq!(map.grid().x.step_mm(), 0.5);
        [z[[19, 0]], z[[19, 29]], z[[0, 0]], z[[0, 29]]].map(|v| v.round())
    };
    assert_eq!(corners("0"), [7.0, 0.0, 0.0, 0.0]);
    assert_eq!(corners("3"), [0.0, 3.0, 0.0, 0.0]);
    let said = refused("two.gwy", &["--dataset", "4"]);
    assert!(said.contains("si_unit_z: is \"V\""), "{said}");
    let said = refused("two.gwy", &["--dataset", "7"]);
    assert!(said.contains("\"7\" is no channel of the file; it holds: 0 (Height)"), "{said}");
    let said = refused("two.gwy", &["--mask", "0"]);
    assert!(said.contains("mask: \"0\" was asked for"), "{said}");
    let (_, _, warned) = read("map.gwy", &[]);
    assert!(warned.contains("marks 12 pixel(s), which are read as invalid"), "{warned}");
}

/// Checks MATLAB structures, compressed or not, and nested ones: a field has the name `structure.field`.
#[test]
fn a_field_of_a_structure_is_read_by_its_name() {
    let names = ["--dataset", "mirror.Z", "--x", "mirror.about.X", "--y", "mirror.about.Y"];
    let flags = [&names[..], &["--unit", "nm", "--coordinate-unit", "mm"]].concat();
    for file in ["struct.mat", "struct-plain.mat"] {
        let (map, ..) = read(file, &flags);
        is_truth(&map, 0.0, 12);
        has_rms(&map, 3.4794);
        let said = refused(file, &["--dataset", "mirror.W", "--unit", "nm", "--pixel-mm", "0.5"]);
        assert!(said.contains("has no numeric matrix \"mirror.W\""), "{said}");
        assert!(said.contains("mirror.Z, mirror.about.X"), "{said}");
    }
}

#[test]
fn code_v_has_no_pitch() {
    let said = refused("map.int", &[]);
    assert!(said.contains("give --pixel-mm"), "{said}");
    let (map, _, _) = read("map.int", &["--pixel-mm", "0.5"]);
    // A whole number is 632.8 nm / 10000; half of it.
    is_truth(&map, 0.0317, 12);
    let said = refused("map.int", &["--pixel-mm", "0.5", "--wavelength-nm", "633"]);
    assert!(said.contains("is 632.8 in the file, 633 was asked for"), "{said}");
}

#[test]
fn a_presurface_has_no_units() {
    let said = refused("presurface.dat", &["--unit", "m"]);
    assert!(said.contains("give --coordinate-unit"), "{said}");
    let (map, _, _) = read("presurface.dat", &["--unit", "m", "--coordinate-unit", "m"]);
    // Seven digits of 65 nm.
    is_truth(&map, 1e-5, 0);
    has_rms(&map, 3.4806);
}

#[test]
fn digital_surf_heights_are_relative() {
    let (map, manifest, _) = read("map.sur", &[]);
    assert_eq!(invalid(&map), 0);
    // The writer filled the invalid pixels: its own RMS.
    assert!((map.statistics().rms - 3.511).abs() < 5e-4, "{}", map.statistics().rms);
    let truth = truth();
    for (found, right) in map.height_nm().iter().zip(&truth).filter(|(_, right)| !right.is_nan()) {
        // Offset by the writer so that -7.5 .. 7.5 nm fill the numbers; dz and the offset are 32-bit floats.
        assert!((found + 57.5 - right).abs() < 1e-4, "{found} {right}");
    }
    // A 32-bit float.
    assert!((map.grid().x.step_mm() - 0.5).abs() < 1e-7);
    let offset = manifest.outcome["reading"]["stated"]["z_offset"].as_f64().unwrap();
    // A 32-bit float of nm: 6e-8 of 0.0575, and that of its factor.
    assert!((offset - 0.0575).abs() < 1e-8, "{offset}");
}

#[test]
fn scattered_points_are_gridded_on_request() {
    let said = refused("polar.xyz", &["--unit", "nm", "--coordinate-unit", "mm"]);
    assert!(said.contains("give --grid-mm"), "{said}");
    let flags = ["--unit", "nm", "--coordinate-unit", "mm", "--grid-mm", "1"];
    let (map, manifest, warned) = read("polar.xyz", &flags);
    assert!(warned.contains("interpolated: linear in Delaunay triangles"), "{warned}");
    assert_eq!(manifest.outcome["reading"]["stated"]["points"], 109);
    let g = map.grid();
    // The heights are 0.004 r^2 on rings of 12 points, 5 mm apart, to 45 mm. Chords are above a convex surface, by at most
    // c d^2 / 6 with c = 0.008 and sides d of 24 mm; 4 decimals in the file.
    let mut valid = 0;
    for ((r, c), z) in map.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan()) {
        let square = g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2);
        let above = z - 0.004 * square;
        assert!((-1e-4..0.008 * 576.0 / 6.0).contains(&above), "{square}: {z}");
        valid += 1;
    }
    // The polygon of 12 corners: 3 R^2 pixels of 1 mm^2; a pixel in fifty lies on its edges.
    assert!((f64::from(valid) / (3.0 * 45.0 * 45.0) - 1.0).abs() < 0.02, "{valid}");
    let said = refused("truth.npy", &["--unit", "nm", "--pixel-mm", "1", "--grid-mm", "1"]);
    assert!(said.contains("only lines x y z are interpolated"), "{said}");
    let said = refused("camera.xyz", &["--grid-mm", "1"]);
    assert!(said.contains("has its pixels on a grid"), "{said}");
}

/// Checks that a damaged or unusual file of each format is refused with the right reason.
#[test]
fn what_a_reader_does_not_know_is_refused() {
    let tmp = tempfile::tempdir().unwrap();
    let said = |file: &str, format: &str, change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = fs::read(Path::new(CASES).join(file)).unwrap();
        change(&mut bytes);
        let path = tmp.path().join("changed");
        fs::write(&path, bytes).unwrap();
        refused(path.to_str().unwrap(), &["--format", format])
    };
    let text = |from: &'static str, to: &'static str| {
        move |bytes: &mut Vec<u8>| {
            let text = String::from_utf8_lossy(bytes).into_owned();
            assert!(text.contains(from), "{from}");
            *bytes = text.replacen(from, to, 1).into_bytes();
        }
    };
    let bytes = |from: &'static str, to: &'static str| {
        move |bytes: &mut Vec<u8>| {
            let found = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
            bytes[found..found + to.len()].copy_from_slice(to.as_bytes());
        }
    };
    let cut = |bytes: &mut Vec<u8>| bytes.truncate(bytes.len() - 27);
    for (file, format) in [
        ("map.gsf", "gsf"),
        ("map.gwy", "gwy"),
        ("map.sur", "sur"),
        ("map.int", "codev-int"),
        ("grid-sag.dat", "grid-sag"),
        ("map.x3p", "x3p"),
        ("presurface.dat", "presurface"),
    ] {
        let message = said(file, format, &cut);
        assert!(message.contains("truncated"), "{message}");
        assert!(said(file, format, &|b: &mut Vec<u8>| b.truncate(1)).contains("changed: "));
    }
    // A block after the map is cut, and the map.
    assert!(said("map.opd", "opd", &|b: &mut Vec<u8>| b.truncate(2000)).contains("truncated"));
    assert!(said("4sight.h5", "4sight", &|b: &mut Vec<u8>| b.truncate(5000)).contains("HDF5"));

    let at = |at: usize, new: &'static [u8]| {
        move |bytes: &mut Vec<u8>| bytes[at..at + new.len()].copy_from_slice(new)
    };
    assert!(said("map.sur", "sur", &at(0, b"DSCOMPRESSED")).contains("is compressed"));
    assert!(said("map.sur", "sur", &at(18, b"\x01")).contains("of type 1, not one surface"));
    assert!(said("map.sur", "sur", &at(14, b"\x02")).contains("holds 2 object(s)"));
    assert!(said("map.sur", "sur", &at(98, b"\x08")).contains("numbers of 8 bits"));
    assert!(said("map.sur", "sur", &at(290, b"\x01")).contains("states the inversion 1"));
    assert!(said("map.sur", "sur", &at(108, b"\xff\xff\xff\x7f")).contains("at most"));
    // The number of bytes per height, after the directory of seven blocks.
    assert!(said("map.opd", "opd", &at(2 + 168 + 4, b"\x01")).contains("numbers of 1 bytes"));
    assert!(said("map.opd", "opd", &at(2 + 168, b"\xff\xff\xff\xff")).contains("at most"));
    assert!(
        said("map.x3p", "x3p", &at(400, b"\xff\xff\xff")).contains("is broken in \"main.xml\"")
    );
    assert!(said("map.gwy", "gwy", &at(0, b"GWYO")).contains("does not start with \"GWYP\""));
    assert!(said("map.gwy", "gwy", &at(4, b"X")).contains("not a GwyContainer"));
    assert!(said("map.gwy", "gwy", &|b: &mut Vec<u8>| b.extend([0; 3])).contains("3 bytes after"));
    assert!(said("map.gwy", "gwy", &bytes("xres\0i\x1e", "xres\0i\x1d")).contains("600 heights"));
    assert!(said("map.gwy", "gwy", &bytes("xres\0i\x1e", "xres\0z\x1e")).contains("type 7A"));
    assert!(said("map.gsf", "gsf", &|b: &mut Vec<u8>| b.extend([0; 3])).contains("3 bytes after"));
    assert!(
        said("grid-sag.dat", "grid-sag", &text("0.5 0.5 0 0 0", "0.5 0.5 7 0 0"))
            .contains("unit flag 7")
    );
    assert!(said("map.int", "codev-int", &text("SUR", "FIL")).contains("intensity filter"));
    assert!(said("map.int", "codev-int", &text("GRD", "ZFR")).contains("holds ZFR, polynomials"));
    assert!(said("map.int", "codev-int", &text("SSZ 10000", "")).contains("has no SSZ"));
    assert!(
        said("presurface.dat", "presurface", &text("30 20", "29 20")).contains("more than 29 x 20")
    );
}

#[test]
fn special_points_of_digital_surf_and_bits_of_opd_are_invalid() {
    let tmp = tempfile::tempdir().unwrap();
    let changed = |file: &str, change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = fs::read(Path::new(CASES).join(file)).unwrap();
        change(&mut bytes);
        let path = tmp.path().join(file);
        fs::write(&path, bytes).unwrap();
        read(path.to_str().unwrap(), &[]).0
    };
    // The first number, the upper left pixel, becomes the least value less two; special points are stated.
    let map = changed("map.sur", &|b| {
        b[86] = 1;
        let least = i32::from_le_bytes(b[100..104].try_into().unwrap());
        b[512..516].copy_from_slice(&(least - 2).to_le_bytes());
    });
    assert!(map.height_nm()[[19, 0]].is_nan() && invalid(&map) == 1);
    // Absolute heights have the offset.
    let map = changed("map.sur", &|b| b[88] = 1);
    // Offset and step are 32-bit floats, as above.
    assert!((map.height_nm()[[19, 29]] - 65.0).abs() < 1e-4, "{}", map.height_nm()[[19, 29]]);
    // Integers of waves / Mult: the map becomes 16-bit numbers k at (x, y) = (k / 20, k mod 20), the third one is invalid.
    let map = changed("map.opd", &|b| {
        let data = 2 + 168 + 6;
        b[data - 2] = 2;
        let mult = u16::from_le_bytes(b[data + 2400 + 12..data + 2400 + 14].try_into().unwrap());
        assert_ne!(mult, 0);
        for k in 0..600_u16 {
            let at = data + 2 * usize::from(k);
            b[at..at + 2].copy_from_slice(&(if k == 2 { 32767 } else { k }).to_le_bytes());
        }
    });
    assert!(map.height_nm()[[2, 0]].is_nan() && invalid(&map) == 1);
    let step = map.height_nm()[[1, 0]];
    // Rounding of a quotient.
    assert!((map.height_nm()[[0, 1]] / step - 20.0).abs() < 1e-9);
}

#[test]
fn a_format_that_is_not_known_is_described() {
    let tmp = tempfile::tempdir().unwrap();
    for (bytes, expected) in [
        (&b"\x89PNG\r\n\x1a\n"[..], "a PNG picture; export the heights"),
        (b"1 2 3\n4 5 6\n", "lines of 3 numbers; give --format xyz for lines x y z; save"),
        (b"1 2 3 4\n4 5 6 7\n", "4 numbers in its first line; give --format csv"),
        (b"height map\n1 2\n", "text that begins \"height map\"; give --format csv"),
        (b"\x01\x02\xff\x00", "binary data that begins 01 02 FF 00; export it"),
    ] {
        let path = tmp.path().join("a.bin");
        fs::write(&path, bytes).unwrap();
        let said = refused(path.to_str().unwrap(), &[]);
        assert!(said.contains(expected), "{said}");
        assert!(said.contains("Formats: metropro, datx,") && said.contains("x3p, opd,"), "{said}");
    }
}

/// Writes a file into a new temporary directory. Returns the directory, which exists as long as this value, and the
/// path.
fn put(name: &str, bytes: &[u8]) -> (tempfile::TempDir, String) {
    let tmp = tempfile::tempdir().unwrap();
    let path = tmp.path().join(name);
    fs::write(&path, bytes).unwrap();
    let path = path.to_str().unwrap().to_string();
    (tmp, path)
}

/// Returns the map of [`truth`] as text, one line per row, with four decimals. `word` stands at invalid pixels.
fn table(separator: &str, word: &str) -> String {
    let field = |v: &f64| if v.is_nan() { word.to_string() } else { format!("{v:.4}") };
    let line = |row: ndarray::ArrayView1<f64>| {
        row.iter().map(field).collect::<Vec<_>>().join(separator) + "\n"
    };
    truth().rows().into_iter().map(line).collect()
}

/// Half a unit of the last of four decimals, nm, and a margin for rounding.
const FOUR_DECIMALS_NM: f64 = 5.1e-5;

#[test]
fn tables_of_other_programs_have_no_pixel_less() {
    let flags = ["--unit", "nm", "--pixel-mm", "0.5"];
    let utf16: Vec<u8> = [0xFEFF]
        .into_iter()
        .chain(table("\t", "").encode_utf16())
        .flat_map(u16::to_le_bytes)
        .collect();
    let quoted =
        table("\",\"", "").lines().map(|line| format!("\"{line}\"\r\n")).collect::<String>();
    let files = [
        // The first row begins with the word of a spreadsheet, which is no comment.
        ("a.csv", table("\t", "#N/A").into_bytes()),
        ("b.csv", table(",", "").into_bytes()),
        ("c.csv", table(",", "***").into_bytes()),
        ("d.csv", table(" ", "--").into_bytes()),
        ("e.csv", table(",", "1.#QNAN").into_bytes()),
        ("f.csv", table(";", "-nan(ind)").replace('.', ",").into_bytes()),
        ("g.csv", table(" ", "nan").replace('.', ",").into_bytes()),
        ("h.csv", utf16),
        ("i.csv", quoted.into_bytes()),
        ("j.csv", [b"# Pr\xFCfling, \xB5\n", table(",", "NaN").as_bytes()].concat()),
        ("k.csv", table(",", "BAD").replace('\n', ",\r\n").into_bytes()),
    ];
    for (name, bytes) in files {
        let (_tmp, path) = put(name, &bytes);
        let (map, _, _) = read(&path, &flags);
        is_truth(&map, FOUR_DECIMALS_NM, 12);
    }
    // Invalid pixels at the ends of lines, and a line of nothing else, are pixels.
    for separator in [",", "\t"] {
        let mut rows: Vec<Vec<&str>> =
            vec![vec!["1.5", "2.5", "4.5", ""], vec![""; 4], vec!["3", "", "1", "2"]];
        rows.push(vec!["", "5", "", "7"]);
        let text = rows.iter().map(|row| row.join(separator) + "\n").collect::<String>();
        let (_tmp, path) = put("a.csv", text.as_bytes());
        let (map, _, _) = read(&path, &flags);
        assert_eq!((map.height_nm().dim(), invalid(&map)), ((4, 4), 8));
        assert_eq!(map.height_nm()[[3, 3]], 7.0);
    }
}

#[test]
fn tables_that_are_no_map_are_refused() {
    let flags = ["--unit", "nm", "--pixel-mm", "0.5"];
    let heights = table(",", "50");
    let said = |text: &str| {
        let (_tmp, path) = put("a.csv", text.as_bytes());
        refused(&path, &flags)
    };
    let numbers = (0..30).map(|i| i.to_string()).collect::<Vec<_>>().join(",");
    assert!(said(&format!("{numbers}\n{heights}")).contains("the first line goes in equal steps"));
    let rows = heights.lines().enumerate().map(|(i, line)| format!("{i},{line}\n"));
    assert!(said(&rows.collect::<String>()).contains("the first column goes in equal steps"));
    let blocks = format!("# name: X\n{heights}\n# name: Z\n{heights}");
    assert!(
        said(&blocks).contains("has 20 rows, then blank lines or comments"),
        "{}",
        said(&blocks)
    );
    let profile = (0..20).map(|i| format!("{i},{}\n", i * i)).collect::<String>();
    assert!(said(&profile).contains("20 lines of 2 numbers, which are a profile"));
    assert!(said("1,500;2,250\n3,125;4,000\n").contains("decimal commas, or marks of thousands"));
    // A blank line after every row separates nothing.
    let (_tmp, path) = put("a.csv", heights.replace('\n', "\n\n").as_bytes());
    assert_eq!(read(&path, &flags).0.height_nm().dim(), (20, 30));
}

#[test]
fn words_above_the_numbers_are_obeyed_or_quoted() {
    let text = format!("# Pixel size (um): 500\n# Z unit: nm\n{}", table(",", "nan"));
    let (_tmp, path) = put("a.csv", text.as_bytes());
    is_truth(&read(&path, &[]).0, FOUR_DECIMALS_NM, 12);
    assert!(refused(&path, &["--unit", "um"]).contains("is nm in the file, um was asked for"));
    assert!(refused(&path, &["--pixel-mm", "1"]).contains("0.5 x 0.5 mm in the file"));
    let text = format!("# heights in um\n# scale unit: 3\n{}", table(",", "nan"));
    let (_tmp, path) = put("a.csv", text.as_bytes());
    let said = refused(&path, &["--unit", "nm", "--pixel-mm", "0.5"]);
    assert!(said.contains("is um in the file, nm was asked for"), "{said}");
    let (_, _, warned) = read(&path, &["--unit", "um", "--pixel-mm", "0.5"]);
    let right = "statements that are not used: \"scale unit: 3\" (line 2)";
    assert!(warned.contains(right), "{warned}");

    let point = |((row, column), v): ((usize, usize), &f64)| {
        format!("{};{};{v:.4}\n", column as f64 * 0.5, row as f64 * 0.5)
    };
    let points = truth().indexed_iter().map(point).collect::<String>();
    let (_tmp, path) = put("a.xyz", format!("x (mm);y (mm);z [nm]\n{points}").as_bytes());
    is_truth(&read(&path, &[]).0, FOUR_DECIMALS_NM, 12);
    assert!(refused(&path, &["--unit", "um"]).contains("is nm in the file, um was asked for"));
    let (_tmp, path) = put("a.xyz", format!("y_mm;x_mm;z_nm\n{points}").as_bytes());
    assert!(refused(&path, &[]).contains("give the columns in the order x y z"));
    // A value far from all others is doubted.
    let (_tmp, path) = put("a.csv", table(",", "-9999").as_bytes());
    let (_, _, warned) = read(&path, &["--unit", "nm", "--pixel-mm", "0.5"]);
    assert!(warned.contains("12 pixels have the stored value -9999"), "{warned}");
    assert!(warned.contains("give --no-data -9999"), "{warned}");
}

#[test]
fn what_hdf5_and_matlab_say_beside_the_numbers_is_obeyed() {
    let pitch = ["--pixel-mm", "0.5"];
    // 32-bit floats of 65 nm.
    let single = 65.0 * 6e-8;
    let said = refused("truth-values.h5", &pitch);
    assert!(said.contains("holds \"hidden\"") && said.contains("--mask hidden"), "{said}");
    let (map, _, _) = read("truth-values.h5", &[&pitch[..], &["--mask", "hidden"]].concat());
    is_truth(&map, single, 12);
    // Dimension scales state that the rows are x.
    is_truth(&read("turned.h5", &[]).0, single, 12);
    assert!(refused("turned.h5", &["--pixel-mm", "1"]).contains("has coordinates with the steps"));
    let (map, _, warned) = read("half.h5", &pitch);
    // Half a step of a 16-bit float below 128 nm: 2^6 / 2^11.
    is_truth(&map, 2f64.powi(-5), 12);
    assert!(warned.is_empty(), "{warned}");
    // The file has its attribute pixel_size_mm.
    is_truth(&read("half.h5", &[]).0, 2f64.powi(-5), 12);
    assert!(refused("half.h5", &["--pixel-mm", "1"]).contains("0.5 x 0.5 mm in the file"));
    let (map, _, warned) = read("fill-value.h5", &pitch);
    is_truth(&map, single, 12);
    assert!(warned.contains("12 pixel(s) have the fill value -9999"), "{warned}");

    let flags = ["--unit", "nm", "--pixel-mm", "0.5"];
    let said = refused("logical.mat", &flags);
    assert!(said.contains("holds \"valid\"") && said.contains("--dataset Z"), "{said}");
    let (map, _, warned) = read("ndgrid.mat", &["--unit", "nm", "--coordinate-unit", "mm"]);
    is_truth(&map, single, 12);
    assert!(warned.contains("the map was transposed"), "{warned}");
}

/// Checks surface data files with 64-bit floats, whose least float marks invalid pixels.
#[test]
fn surface_data_files_mark_by_the_least_float() {
    for magic in ["bISO-1.0", "bBCR-1.0", "bISO-2.0"] {
        let mut bytes = format!("{magic}{:<10}{}", "hand", "010120260000".repeat(2)).into_bytes();
        for size in [30u32, 20] {
            let most = if magic.ends_with("2.0") { 4 } else { 2 };
            bytes.extend(&size.to_le_bytes()[..most]);
        }
        for scale in [0.5e-3_f64, 0.5e-3, 1e-9, -1.0] {
            bytes.extend(scale.to_le_bytes());
        }
        bytes.extend([0, 7, 0]);
        for v in &truth() {
            bytes.extend(if v.is_nan() { f64::MIN } else { *v }.to_le_bytes());
        }
        let (_tmp, path) = put("a.sdf", &bytes);
        // 1e-9 m and 1e9 nm round.
        is_truth(&read(&path, &[]).0, 1e-12 * 65.0, 12);
    }
}

#[test]
fn an_image_of_fits_has_a_name() {
    let mut bytes = fs::read(Path::new(CASES).join("mask.fits")).unwrap();
    let end = bytes.windows(80).rposition(|card| card.starts_with(b"END  ")).unwrap();
    bytes[end..end + 160]
        .copy_from_slice(format!("{:<80}{:<80}", "EXTNAME = 'DQ'", "END").as_bytes());
    let (_tmp, path) = put("a.fits", &bytes);
    let flags = ["--pixel-mm", "0.5", "--dataset", "0"];
    let (map, _, _) = read(&path, &[&flags[..], &["--mask", "dq"]].concat());
    assert_eq!(invalid(&map), 158);
    assert!(refused(&path, &[&flags[..], &["--mask", "other"]].concat()).contains("no HDU other"));
    let said = refused(&path, &["--pixel-mm", "0.5", "--dataset", "SCI"]);
    assert!(said.contains("has no HDU \"SCI\", only 2"), "{said}");
}

/// Returns the path of a file of the second collection of cases.
fn second(file: &str) -> String {
    Path::new(CASES).with_file_name("cases-2").join(file).to_str().unwrap().to_string()
}

/// Returns the map that the files of the second collection hold, nm (ny, nx). Row 0 is the smallest y.
fn second_truth() -> Array2<f64> {
    let bytes = fs::read(second("truth.npy")).unwrap();
    planish_import::read(planish_import::Format::Npy, &bytes, &Default::default()).unwrap().values
}

/// Checks that `map` is that of [`second_truth`] on pixels of 0.5 mm, with every height within `tolerance_nm`.
fn is_second_truth(map: &Surface, tolerance_nm: f64) {
    let truth = second_truth();
    assert_eq!(map.height_nm().dim(), truth.dim());
    let g = map.grid();
    assert!((g.x.step_mm() / 0.5 - 1.0).abs() < 1e-6 && (g.y.step_mm() / 0.5 - 1.0).abs() < 1e-6);
    for ((at, found), right) in map.height_nm().indexed_iter().zip(&truth) {
        assert!((found - right).abs() <= tolerance_nm, "pixel {at:?}: {found}, not {right}");
    }
}

/// Writes a text to the file `name` in `dir`, and returns its path.
fn put_text(dir: &Path, name: &str, text: &str) -> String {
    let path = dir.join(name);
    fs::write(&path, text).unwrap();
    path.to_str().unwrap().to_string()
}

#[test]
fn a_unit_in_the_names_of_columns_is_read_and_contradicts_a_flag() {
    for (file, unit, flags) in [
        ("angstrom.xyz", "angstrom", &[][..]),
        ("mil.xyz", "mil", &[]),
        ("wv.xyz", "waves", &["--wavelength-nm", "632.8"]),
    ] {
        let path = second(file);
        let (map, manifest, _) = read(&path, flags);
        // 9 digits of 61 nm, or 5 decimals of an angstrom.
        is_second_truth(&map, 1e-6);
        assert_eq!(manifest.outcome["reading"]["unit"], unit);
        let said = refused(&path, &["--unit", "nm"]);
        assert!(said.contains(&format!("is {unit} in the file, nm was asked for")), "{said}");
        assert!(said.contains("--override-file"), "{said}");
    }
    assert!(refused(&second("wv.xyz"), &[]).contains("give --wavelength-nm"));
    // Other words of the same kind, and words that nobody understands.
    let tmp = tempfile::tempdir().unwrap();
    let points = "0,0,1\n1,0,2\n0,1,3\n1,1,4\n";
    for (name, nm) in [
        ("z (inch)", 25.4e6),
        ("z [\u{b5}m]", 1e3),
        ("z (\u{3bc}m)", 1e3),
        ("z_nm", 1.0),
        ("z (\u{c5})", 0.1),
        ("H\u{f6}he [micron]", 1e3),
        ("z (thou)", 25.4e3),
        ("z (pm)", 1e-3),
    ] {
        let text = format!("x (mm),y (mm),{name}\n{points}");
        let (map, _, _) = read(&put_text(tmp.path(), "a.xyz", &text), &[]);
        // The factor and the height are rounded once each.
        assert!((map.height_nm()[[1, 1]] / (4.0 * nm) - 1.0).abs() < 1e-15, "{name}");
    }
    let said = refused(
        &put_text(tmp.path(), "b.xyz", &format!("x (mm),y (mm),z (furlong)\n{points}")),
        &["--unit", "nm"],
    );
    assert!(said.contains("\"furlong\"") && said.contains("no known unit"), "{said}");
    let said = refused(
        &put_text(tmp.path(), "c.xyz", &format!("x (mm),y (mm),z (fringes)\n{points}")),
        &[],
    );
    assert!(said.contains("fringes"), "{said}");
    // Numbers of pixels have a place too.
    let text = format!(
        "x (px),y (px),z (nm)\n{}",
        points
            .replace("0,0,", "7,5,")
            .replace("1,0,", "8,5,")
            .replace("0,1,", "7,6,")
            .replace("1,1,", "8,6,")
    );
    let path = put_text(tmp.path(), "d.xyz", &text);
    assert!(refused(&path, &[]).contains("give --pixel-mm"));
    let (map, _, _) = read(&path, &["--pixel-mm", "0.5"]);
    assert_eq!((map.grid().x.start_mm(), map.grid().y.start_mm()), (3.5, 2.5));
}

#[test]
fn units_in_a_comment_of_points_are_read_and_contradict_a_flag() {
    for (file, unit) in [("nom.xyz", "um"), ("three_words.xyz", "mm"), ("metres.xyz", "m")] {
        let path = second(file);
        let (map, _, _) = read(&path, &[]);
        // 8 digits of 61 nm.
        is_second_truth(&map, 1e-5);
        let said = refused(&path, &["--unit", "nm"]);
        assert!(said.contains(&format!("is {unit} in the file, nm was asked for")), "{said}");
    }
    let said = refused(&second("metres.xyz"), &["--coordinate-unit", "mm"]);
    assert!(said.contains("is m in the file, mm was asked for"), "{said}");
    // A unit of which nobody says what it is the unit of.
    let tmp = tempfile::tempdir().unwrap();
    let path = put_text(
        tmp.path(),
        "a.xyz",
        "# heights and places\n# unit: um\n0 0 1\n1 0 2\n0 1 3\n1 1 4\n",
    );
    let said = refused(&path, &["--unit", "nm", "--coordinate-unit", "mm"]);
    assert!(said.contains("is um in the file, nm was asked for"), "{said}");
}

#[test]
fn a_text_export_is_read_in_other_languages() {
    let path = second("gwyddion-german.txt");
    let (map, manifest, _) = read(&path, &["--format", "csv"]);
    // Half of the third decimal of a nm, and rounding of the difference.
    is_second_truth(&map, 5.01e-4);
    assert_eq!(manifest.outcome["reading"]["first_row"], "top");
    let said = refused(&path, &["--format", "csv", "--pixel-mm", "1"]);
    assert!(said.contains("0.5 x 0.5 mm in the file, 1 x 1 mm was asked for"), "{said}");
}

#[test]
fn lines_of_text_above_a_matrix_are_read() {
    let (map, manifest, _) = read(&second("keyence.csv"), &[]);
    // Half of the fourth decimal of a nm, and rounding of the difference.
    is_second_truth(&map, 5.01e-5);
    assert_eq!(manifest.outcome["reading"]["first_row"], "top");
    let said = refused(&second("keyence.csv"), &["--unit", "um"]);
    assert!(said.contains("is nm in the file, um was asked for"), "{said}");
    let said = refused(&second("keyence.csv"), &["--pixel-mm", "0.4"]);
    assert!(said.contains("0.5 x 0.5 mm in the file"), "{said}");
    let tmp = tempfile::tempdir().unwrap();
    let cut = fs::read_to_string(second("keyence.csv"))
        .unwrap()
        .replace("\"Vertical\",\"20\"", "\"Vertical\",\"21\"");
    let (_, _, warned) = read(&put_text(tmp.path(), "a.csv", &cut), &[]);
    assert!(warned.contains("states 21 rows, and has 20"), "{warned}");
}

#[test]
fn columns_of_points_are_known_by_name_or_number() {
    let flags = ["--format", "xyz", "--grid-mm", "3"];
    let (map, _, warned) = read(&second("wafer.csv"), &flags);
    assert!(warned.contains("X(mm), Y(mm), Thickness(A)"), "{warned}");
    assert_eq!(map.statistics().valid_count, 7453);
    has_rms(&map, 2.7814);
    let units = ["--unit", "angstrom", "--coordinate-unit", "mm"];
    let (same, _, _) = read(&second("wafer.csv"), &[&flags[..], &units].concat());
    assert_eq!(same.height_nm().dim(), map.height_nm().dim());
    let said = refused(&second("wafer.csv"), &[&flags[..], &["--unit", "nm"]].concat());
    assert!(said.contains("is angstrom in the file, nm was asked for"), "{said}");
    for columns in ["2,3,4", "x,y,thickness", "X(mm),Y(mm),Thickness(A)"] {
        let (chosen, _, _) =
            read(&second("wafer.csv"), &[&flags[..], &["--xyz-columns", columns]].concat());
        assert_eq!(chosen.statistics().rms, map.statistics().rms, "{columns}");
    }
    let said =
        refused(&second("wafer.csv"), &[&flags[..], &["--xyz-columns", "x,y,height"]].concat());
    assert!(said.contains("\"height\" is no column") && said.contains("Thickness(A)"), "{said}");
    // Two columns of values: neither is chosen silently.
    let tmp = tempfile::tempdir().unwrap();
    let two = "Site,X(mm),Y(mm),Thickness(A),GOF\n1,0,0,10,1\n2,1,0,20,1\n3,0,1,30,1\n4,1,1,40,1\n";
    let path = put_text(tmp.path(), "a.xyz", two);
    let said = refused(&path, &[]);
    assert!(said.contains("give --xyz-columns") && said.contains("GOF"), "{said}");
    let (map, _, _) = read(&path, &["--xyz-columns", "X,Y,Thickness"]);
    assert_eq!(map.height_nm()[[1, 1]], 4.0);
    // Without names.
    let path = put_text(tmp.path(), "b.xyz", "1 0 0 10\n2 1 0 20\n3 0 1 30\n4 1 1 40\n");
    assert!(refused(&path, &["--unit", "nm"]).contains("give --xyz-columns"));
    let flags = ["--xyz-columns", "2,3,4", "--unit", "nm", "--coordinate-unit", "mm"];
    assert_eq!(read(&path, &flags).0.height_nm()[[1, 1]], 40.0);
}

#[test]
fn rounded_coordinates_lie_on_a_grid() {
    let (map, _, warned) = read(&second("rounded.xyz"), &[]);
    assert_eq!(map.height_nm().dim(), (20, 30));
    has_rms(&map, 7.2594);
    let g = map.grid();
    assert!((g.x.step_mm() - 1.0).abs() < 1e-9, "{}", g.x.step_mm());
    // Rounding of 20 coordinates to 0.01 mm: a standard error of 0.01 / sqrt(12) over sqrt(20^3 / 12) steps.
    assert!((g.y.step_mm() - 0.2763).abs() < 5e-4, "{}", g.y.step_mm());
    assert!(warned.contains("the coordinates y are rounded"), "{warned}");
    // A pixel that is absent, and points that are scattered.
    let line =
        |i: usize, j: usize, x: f64| format!("{:.2} {:.2} {}\n", x, 0.2763 * j as f64, i + j);
    let holed: String = (0..6)
        .flat_map(|j| (0..5).filter(move |i| (*i, j) != (2, 3)).map(move |i| line(i, j, i as f64)))
        .collect();
    let tmp = tempfile::tempdir().unwrap();
    let flags = ["--unit", "nm", "--coordinate-unit", "mm"];
    let (map, _, _) = read(&put_text(tmp.path(), "a.xyz", &holed), &flags);
    assert_eq!((map.height_nm().dim(), invalid(&map)), ((6, 5), 1));
    let scattered: String =
        (0..30).map(|i| line(i, i % 6, (i * i % 37) as f64 * 0.31 + (i as f64).sin())).collect();
    assert!(refused(&put_text(tmp.path(), "b.xyz", &scattered), &flags).contains("give --grid-mm"));
}

#[test]
fn rates_keep_their_time() {
    let tmp = tempfile::tempdir().unwrap();
    let tif = |file: &str, flags: &[&str]| -> Result<(f64, f64), String> {
        let out = tmp.path().join("tif");
        let output = planish_testkit::program::stage("planish-import")
            .args([&["tif", file, "--force", "--out", out.to_str().unwrap()], flags].concat())
            .output()
            .unwrap();
        match output.status.code() {
            Some(0) => {
                let tif = artifact::read::<planish_types::Tif>(&out).unwrap().value;
                Ok((tif.peak_nm_per_s(), tif.vrr_nm_mm2_per_s()))
            }
            _ => Err(String::from_utf8_lossy(&output.stderr).into_owned()),
        }
    };
    let is_right = |(peak, vrr): (f64, f64)| {
        // 5 digits of the samples.
        assert!(
            (peak / 2.0 - 1.0).abs() < 1e-4 && (vrr / 40.6857 - 1.0).abs() < 1e-4,
            "{peak} {vrr}"
        );
    };
    let mat = ["--rate", "--dataset", "rate_nm_per_min", "--coordinate-unit", "mm"];
    is_right(tif(&second("tif.mat"), &mat).unwrap());
    is_right(tif(&second("tif.mat"), &[&mat[..], &["--unit", "nm/min"]].concat()).unwrap());
    let said = tif(&second("tif.mat"), &[&mat[..], &["--unit", "nm"]].concat()).unwrap_err();
    assert!(said.contains("is nm/min in the file, nm was asked for"), "{said}");
    is_right(tif(&second("tif.csv"), &["--rate"]).unwrap());
    is_right(tif(&second("tif.csv"), &["--rate", "--unit", "nm per minute"]).unwrap());
    let said = tif(&second("tif.csv"), &["--rate", "--unit", "nm/s"]).unwrap_err();
    assert!(said.contains("is nm/min in the file, nm/s was asked for"), "{said}");
    for flags in [&["--rate"][..], &["--rate", "--unit", "nm"], &["--rate", "--unit", "nm/s"]] {
        let (peak, vrr) = tif(&second("tif_nm_per_s.csv"), flags).unwrap();
        assert!((peak - 120.0).abs() < 0.01 || (peak - 2.0).abs() < 1e-3, "{peak} {vrr}");
    }
    // A rate in um/h, stated on the command line alone.
    let text = fs::read_to_string(second("tif.csv")).unwrap().replace("# unit: nm/min\n", "");
    let path = put_text(tmp.path(), "plain.csv", &text);
    let (peak, _) = tif(&path, &["--rate", "--unit", "um/h"]).unwrap();
    assert!((peak / (120.0 / 3.6) - 1.0).abs() < 1e-4, "{peak}");
    assert!(tif(&path, &["--rate"]).unwrap_err().contains("nm/min"));
    // Rates are no heights, and no depths.
    let said = refused(&second("tif.csv"), &[]);
    assert!(
        said.contains("is nm/min, a removal rate") && said.contains("planish tool from-maps"),
        "{said}"
    );
    let depth = ["--dwell-s", "10", "--half-size-mm", "3"];
    assert!(tif(&second("tif.csv"), &depth).unwrap_err().contains("a removal rate"));
}

#[test]
fn windows_of_a_camera_keep_their_places() {
    let maps: Vec<Surface> =
        (0..3).map(|k| read(&second(&format!("sub{k}.datx")), &[]).0).collect();
    for (map, place) in maps.iter().zip([0.0, 9.0, 18.0]) {
        assert!((map.grid().x.start_mm() - maps[0].grid().x.start_mm() - place).abs() < 1e-9);
        assert_eq!(map.grid().y, maps[0].grid().y);
        // Row 100 is the first: 100.5 .. 115.5 rows below the upper edge of the camera.
        assert_eq!((map.grid().y.start_mm(), map.grid().y.end_mm()), (-57.5, -50.0));
    }
    // A place that the file does not state, and one that contradicts it.
    let flags = ["--unit", "nm", "--pixel-mm", "0.5", "--place-mm", "12,-3"];
    let (map, _, _) = read(&second("truth.npy"), &flags);
    assert_eq!((map.grid().x.start_mm(), map.grid().y.start_mm()), (12.0, -3.0));
    let said = refused(&second("sub1.datx"), &["--place-mm", "12,-3"]);
    assert!(said.contains("9, -57.5 mm in the file, 12, -3 mm was asked for"), "{said}");
    let (map, _, _) = read(&second("sub1.datx"), &["--place-mm", "12,-3", "--override-file"]);
    assert_eq!(map.grid().x.start_mm(), 12.0);
}

#[test]
fn formats_of_neighbouring_programs_are_read() {
    let (map, manifest, _) = read(&second("mirror.wft"), &[]);
    assert_eq!(map.statistics().valid_count, 613);
    has_rms(&map, 39.0896);
    assert!((map.grid().x.step_mm() - 200.0 / 28.0).abs() < 1e-12);
    // The middle of the mirror is the origin; the first row of the file is the bottom.
    assert!(
        map.grid().x.coordinate_mm(16).abs() < 1e-12
            && map.grid().y.coordinate_mm(16).abs() < 1e-12
    );
    assert!((map.height_nm()[[2, 16]] + 0.35 * 0.5 * 632.8).abs() < 1e-9);
    assert_eq!(manifest.outcome["reading"]["stated"]["radius_of_curvature_mm"], 1600.0);
    let said = refused(&second("mirror.wft"), &["--surface-per-value", "0.5"]);
    assert!(said.contains("is 0.5 in the file and applied"), "{said}");

    let (map, _, warned) = read(&second("mirror_2d.dat"), &[]);
    // 6 digits of 61 nm.
    is_second_truth(&map, 1e-4);
    assert!(warned.contains("x goes down the first column"), "{warned}");
    let (same, _, _) = read(
        &second("mirror_2d.dat"),
        &["--format", "srw", "--unit", "m", "--coordinate-unit", "m"],
    );
    assert_eq!(same.height_nm(), map.height_nm());
    let said = refused(
        &second("mirror_2d.dat"),
        &["--format", "csv", "--unit", "m", "--coordinate-unit", "m"],
    );
    assert!(said.contains("give --format srw"), "{said}");
}

#[test]
fn numbers_and_texts_beside_an_array_are_read() {
    let (map, manifest, _) = read(&second("map.npz"), &[]);
    // The factor and the heights are rounded once each.
    is_second_truth(&map, 1e-12);
    assert_eq!(manifest.outcome["reading"]["format"], "npz");
    let said = refused(&second("map.npz"), &["--unit", "nm"]);
    assert!(said.contains("is um in the file, nm was asked for"), "{said}");
    let said = refused(&second("map.npz"), &["--pixel-mm", "1"]);
    assert!(said.contains("0.5 x 0.5 mm in the file, 1 x 1 mm was asked for"), "{said}");
}

#[test]
fn slopes_become_heights() {
    let tmp = tempfile::tempdir().unwrap();
    let out = tmp.path().join("map");
    let run = |flags: &[&str]| {
        planish_testkit::program::stage("planish-import")
            .args(
                [
                    &["slopes", &second("slopes.h5"), "--force", "--out", out.to_str().unwrap()],
                    flags,
                ]
                .concat(),
            )
            .output()
            .unwrap()
    };
    let output = run(&["--pixel-mm", "0.5"]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{said}");
    let map = artifact::read::<Surface>(&out).unwrap().value;
    // The slopes of this case are differences over two pixels, which lack (2 pi 0.5 / 12)^2 / 6 = 1 % of waves of 12 mm, and
    // not slopes in points.
    assert!((map.statistics().rms / 7.2594 - 1.0).abs() < 0.01, "{}", map.statistics().rms);
    let difference = map.height_nm() - &second_truth();
    let mean = difference.mean().unwrap();
    assert!(difference.iter().all(|d| (d - mean).abs() < 0.2), "{difference}");
    for (flags, part) in [
        (&[][..], "give --pixel-mm"),
        (&["--pixel-mm", "0.5", "--slope-unit", "mrad"], "is urad in the file, mrad was asked for"),
        (&["--pixel-mm", "0.5", "--slope-y", "slope_x"], "contradict each other"),
        (&["--pixel-mm", "0.5", "--negate-y"], "with the other sign along y"),
        (&["--pixel-mm", "0.5", "--unit", "nm"], "give --slope-unit"),
    ] {
        let output = run(flags);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        if part == "contradict each other" {
            // No sign of a map of other slopes is certainly right: a warning, or a refusal.
            assert!(said.contains("belong to no surface"), "{said}");
            continue;
        }
        assert_eq!(output.status.code(), Some(2), "{flags:?}: {said}");
        assert!(said.contains(part), "{flags:?}: {said}");
    }
}

/// Returns a log of x = 10 (1 - cos(pi t / 2)) mm, y = 3 t mm, 0.2 s at 1 kHz, after the lines `head`. `line` makes the
/// text of a sample from its index, time (s), x and y (mm).
fn log_of(head: &str, line: impl Fn(i32, f64, f64, f64) -> String) -> String {
    let lines = (0..=200).map(|i| {
        let t = f64::from(i) * 1e-3;
        let x = 10.0 * (1.0 - (std::f64::consts::FRAC_PI_2 * t).cos());
        line(i, t, x, 3.0 * t) + "\n"
    });
    format!("{head}{}", lines.collect::<String>())
}

fn call_trace(
    name: &str,
    bytes: &[u8],
    flags: &[&str],
) -> (Output, Option<artifact::Loaded<Trajectory>>) {
    let (tmp, path) = put(name, bytes);
    let out = tmp.path().join("out");
    let output = planish_testkit::program::stage("planish-import")
        .args([&["trace", &path, "--out", out.to_str().unwrap()][..], flags].concat())
        .output()
        .unwrap();
    let loaded = if out.exists() { artifact::read::<Trajectory>(&out).ok() } else { None };
    (output, loaded)
}

/// Reads a log with the program. Returns the motion, the sampling rate in the manifest (Hz), and the warnings.
fn trace(text: impl AsRef<[u8]>, flags: &[&str]) -> (Trajectory, f64, String) {
    let (output, loaded) = call_trace("log.csv", text.as_ref(), flags);
    let warned = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{flags:?}: {warned}");
    let loaded = loaded.unwrap();
    let rate_hz = loaded.manifest.unwrap().outcome["clock"]["rate_hz"].as_f64().unwrap();
    (loaded.value, rate_hz, warned)
}

fn refused_trace(text: impl AsRef<[u8]>, flags: &[&str]) -> String {
    let (output, loaded) = call_trace("log.csv", text.as_ref(), flags);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!((output.status.code(), loaded.is_none()), (Some(2), true), "{flags:?}: {said}");
    assert!(said.starts_with("error: ") && said.lines().count() == 1, "{said}");
    said
}

/// Checks that the result of [`trace`] is the motion of [`log_of`]: its end within `within_mm`, and 1 kHz to 8 digits.
fn is_the_log((motion, rate_hz, _): &(Trajectory, f64, String), within_mm: f64) {
    // The rate is rounded to the fewest digits that the stamps allow, or fitted to stamps of 9 digits or more.
    assert!((rate_hz / 1000.0 - 1.0).abs() < 1e-8, "{rate_hz}");
    assert!((motion.total_time_s() - 0.2).abs() < 1e-9, "{}", motion.total_time_s());
    let last = motion.segment(motion.len() - 1);
    let end = last.position_mm(last.duration_s);
    let right = [10.0 * (1.0 - (0.1 * std::f64::consts::PI).cos()), 0.6];
    assert!((0..2).all(|a| (end[a] - right[a]).abs() < within_mm), "{end:?}");
}

/// Half a unit of the sixth decimal of a position, mm, and a margin for rounding.
const SIXTH: f64 = 0.6e-6;

#[test]
fn units_of_logs_are_read_from_their_names_or_contradict_a_flag() {
    let log = |head: &str, mm: f64, s: f64| {
        log_of(head, move |_, t, x, y| format!("{:.12},{:.12},{:.12}", t / s, x / mm, y / mm))
    };
    for (head, mm, s, wrong) in [
        ("t (s),x (micron),y (micron)\n", 1e-3, 1.0, ["--unit", "mm"]),
        ("t (s),x (in),y (in)\n", 25.4, 1.0, ["--unit", "mm"]),
        ("t [s],x [mil],y [mil]\n", 0.0254, 1.0, ["--unit", "um"]),
        ("Zeit / min,x / Mikrometer,y / Mikrometer\n", 1e-3, 60.0, ["--time-unit", "s"]),
        ("time_ns,x_mm,y_mm\n", 1.0, 1e-9, ["--time-unit", "us"]),
        ("time (min),x_mm,y_mm\n", 1.0, 60.0, ["--time-unit", "s"]),
        ("t (h),x {m},y {m}\n", 1e3, 3600.0, ["--unit", "mm"]),
    ] {
        is_the_log(&trace(log(head, mm, s), &[]), SIXTH);
        let said = refused_trace(log(head, mm, s), &wrong);
        assert!(
            said.contains("but the log has") && said.contains(&format!("leave {}", wrong[0])),
            "{said}"
        );
    }
    // Each axis in its own unit.
    let mixed =
        log_of("t_s,x_um,y_in\n", |_, t, x, y| format!("{t:.3},{:.6},{:.9}", 1e3 * x, y / 25.4));
    is_the_log(&trace(mixed, &[]), SIXTH);
    let said = refused_trace(log("t_s,x (furlong),y (furlong)\n", 1.0, 1.0), &["--unit", "mm"]);
    assert!(said.contains("\"furlong\" in \"x (furlong)\", which is no known unit"), "{said}");
    let said = refused_trace(log("t_s,x (mm/s),y\n", 1.0, 1.0), &["--unit", "mm"]);
    assert!(said.contains("in mm/s, which is no unit of a position"), "{said}");
    // A flag takes every spelling of the table.
    is_the_log(
        &trace(log("t,x,y\n", 25.4, 60.0), &["--unit", "Inches", "--time-unit", "minutes"]),
        SIXTH,
    );
}

#[test]
fn clocks_of_logs_are_days_dates_hours_and_epochs() {
    let of_day = |t: f64| {
        let ms = (86_399_900 + (1e3 * t).round() as i64) % 86_400_000;
        let (h, m, s) = (ms / 3_600_000, ms / 60_000 % 60, ms / 1000 % 60);
        format!("{h:02}:{m:02}:{s:02}.{:03}", ms % 1000)
    };
    let head = "time,x_mm,y_mm\n";
    let with = |time: &dyn Fn(f64) -> String| {
        log_of(head, |_, t, x, y| format!("{},{x:.6},{y:.6}", time(t)))
    };
    let logs = [
        with(&of_day),
        with(&|t| {
            format!(
                "3/1/2026 {}",
                of_day(t).replace("23:59:", "12:00:").replace("00:00:", "12:01:")
            )
        }),
        with(&|t| format!("1.3.2026 12:00:00.{:03}", (1e3 * t).round())),
        with(&|t| format!("2026-03-01T12:00:00.{:06}+01:00", (1e6 * t).round())),
    ];
    for log in logs {
        is_the_log(&trace(log, &[]), SIXTH);
    }
    // Ten decimals of a day are 8.64 us; 1 kHz is within them, and no other rate of few digits.
    let days = log_of("time (days),x_mm,y_mm\n", |_, t, x, y| {
        format!("46082.{:010},{x:.6},{y:.6}", 5_000_000_000 + (t / 8.64e-6).round() as i64)
    });
    is_the_log(&trace(days, &[]), SIXTH);
    // ROS: nanoseconds since 1970, in metres. As doubles they would have steps of 256 ns.
    let ros = log_of(
        "%time,field.header.seq,field.pose.position.x,field.pose.position.y\n",
        |i, _, x, y| {
            format!(
                "{},{i},{:.9},{:.9}",
                1_760_000_000_123_456_789_i64 + i64::from(i) * 1_000_000,
                x * 1e-3,
                y * 1e-3
            )
        },
    );
    is_the_log(&trace(&ros, &["--unit", "m"]), SIXTH);
    let said = refused_trace(ros.replace("%time", "t_ms"), &["--unit", "m"]);
    assert!(
        said.contains("in ns since 1970") && said.contains("give the right --time-unit"),
        "{said}"
    );
    // Milliseconds since 1970 in whole numbers, at a rate that they do not resolve.
    let ms = log_of("t_ms,x_mm,y_mm\n", |i, _, x, y| {
        format!("{},{x:.6},{y:.6}", 1_772_366_400_000_i64 + i64::from(i * 5 / 2))
    });
    assert_eq!(trace(ms, &[]).1, 400.0);
}

/// Checks times since 1970 at 10 kHz and 10 mm/s. There 0.1 ms is only 420 steps of a double of 1.77e9 s.
#[test]
fn times_since_1970_make_no_accelerations() {
    let log = |time: &dyn Fn(i32) -> String| -> String {
        let lines = (0..400).map(|i| format!("{},{:.6},0\n", time(i), f64::from(i) * 1e-3));
        "t_s,x_mm,y_mm\n".to_string() + &lines.collect::<String>()
    };
    let seconds = log(&|i| format!("17723664{:02}.{:06}", i / 200, (i % 200) * 5000 + 100));
    assert!(seconds.contains("1772366401.0"));
    for text in [
        log(&|i| format!("1772366400.{:06}", 100 * i)),
        log(&|i| format!("2026-03-01T12:00:00.{:06}Z", 100 * i)).replace("t_s", "time"),
    ] {
        let (motion, rate_hz, _) = trace(text, &[]);
        assert_eq!(rate_hz, 10_000.0);
        for segment in motion.segments() {
            let [_, v, a, j] = segment.coefficient_mm[0];
            // Positions of six decimals are exact here; the rest is rounding of 1e-13 mm over 1e-4 s and its square.
            assert!((v - 10.0).abs() < 1e-8 && a.abs() < 1e-3 && j.abs() < 10.0, "{v} {a} {j}");
        }
    }
    assert_eq!(trace(seconds, &[]).1, 200.0);
}

#[test]
fn channels_with_times_of_their_own_are_brought_together() {
    let log = |later: i32| -> String {
        let lines = (0..=200).map(|i| {
            let y = 0.03 * f64::from(i + later);
            format!("{i}\t{:.6}\t{}\t{y:.6}\n", 0.03 * f64::from(i), i + later)
        });
        "Name\tActPos_X\tName\tActPos_Y\nSampleTime[ms]\t1\tSampleTime[ms]\t1\nUnit\tmm\tUnit\tmm\n\n".to_string()
            + &lines.collect::<String>()
    };
    for later in [3, -3] {
        let flags = ["--time", "1", "--x", "2", "--y", "4", "--time-unit", "ms", "--unit", "mm"];
        let (motion, _, warned) = trace(log(later), &flags);
        let at_s = 0.1;
        let segment = motion.segments().filter(|s| s.start_s <= at_s).last().unwrap();
        let [x, y] = segment.position_mm(at_s - segment.start_s);
        // Six decimals.
        assert!((x - 3.0).abs() < SIXTH && (y - 3.0).abs() < SIXTH, "{x} {y}");
        assert_eq!(motion.len(), 197);
        assert!(warned.contains("y by \"Name\"; they are interpolated"), "{warned}");
    }
    let bare = log(3).lines().skip(4).collect::<Vec<_>>().join("\n");
    let said = refused_trace(
        bare,
        &["--time", "1", "--x", "2", "--y", "4", "--time-unit", "ms", "--unit", "mm"],
    );
    assert!(said.contains("column 3 goes like the times in column 1, 3 later"), "{said}");
    assert!(said.contains("give --time-y 3"), "{said}");
}

#[test]
fn text_of_logs_has_commas_encodings_and_footers() {
    let plain = log_of("t (s);x (\u{b5}m);y (\u{b5}m)\n", |_, t, x, y| {
        format!("{t:.3};{:.4};{:.4}", 1e3 * x, 1e3 * y)
    });
    let commas = plain.replace('.', ",");
    let utf16: Vec<u8> =
        [0xFEFF].into_iter().chain(commas.encode_utf16()).flat_map(u16::to_le_bytes).collect();
    let latin: Vec<u8> = plain.chars().map(|c| u8::try_from(c).unwrap()).collect();
    let quoted = plain.lines().map(|line| format!("\"{}\"\r\n", line.replace(';', "\",\"")));
    let footer = plain.clone() + "EOF\n";
    for bytes in [
        commas.as_bytes(),
        &utf16,
        &latin,
        quoted.collect::<String>().as_bytes(),
        commas.replace(';', "\t").as_bytes(),
        footer.as_bytes(),
    ] {
        is_the_log(&trace(bytes, &[]), SIXTH);
    }
    let damaged = plain.replacen("\n0.100;", "\nxx;", 1);
    assert!(
        refused_trace(damaged, &[])
            .contains("\"xx\" in line 102, field 1, where a number should be")
    );
    let said = refused_trace("a title\nand no numbers\n", &[]);
    assert!(
        said.contains("the first of which is \"a title\"") && said.contains("--format"),
        "{said}"
    );
}

#[test]
fn jumps_and_drifts_of_logs_are_named() {
    let log = |jump_mm: f64, drift: f64| -> String {
        let lines = (0..=4000).map(|i| {
            let t = f64::from(i) * 1e-3;
            let at = t / (1.0 + drift);
            let x = 40.0 * (0.8 * at).sin() + if i >= 1500 { jump_mm } else { 0.0 };
            format!("{t:.3},{x:.9},{:.9}\n", 2.0 * at)
        });
        "t_s,x_mm,y_mm\n".to_string() + &lines.collect::<String>()
    };
    let (plan, _, warned) = trace(log(0.0, 0.0), &[]);
    assert!(warned.is_empty(), "{warned}");
    let (_, _, warned) = trace(log(64.0, 0.0), &[]);
    assert!(
        warned.contains("x jumps by 64") && warned.contains("from sample 1499 to the next"),
        "{warned}"
    );
    let tmp = tempfile::tempdir().unwrap();
    let planned = tmp.path().join("plan");
    planish_handoff::save(&planned, &plan).unwrap();
    let flags = ["--planned", planned.to_str().unwrap()];
    let (_, _, warned) = trace(log(0.0, 40e-6), &flags);
    assert!(
        warned.contains("runs 40 parts per million") && warned.contains("faster than the plan"),
        "{warned}"
    );
    assert!(trace(log(0.0, 0.0), &flags).2.is_empty());
}

/// Checks that the log of five axes becomes their motion, in mm and degrees. Without the machine, the message names the
/// axes beside x and y.
#[test]
fn all_axes_of_a_machine_are_read_by_their_names() {
    let text =
        log_of("t (s),x (mm),y (mm),Z Position (um),a_rad,B Feedback (mrad)\n", |_, t, x, y| {
            format!(
                "{t:.3},{x:.9},{y:.9},{:.6},{:.12},{:.9}",
                1e3 * y,
                x.to_radians(),
                1e3 * y.to_radians()
            )
        });
    let (_, _, warned) = trace(&text, &[]);
    assert!(
        warned.contains("positions of z, a, b too, which are not read: give --machine"),
        "{warned}"
    );
    let machine =
        concat!(env!("CARGO_MANIFEST_DIR"), "/../../fixtures/machines/bonnet-five-axis.json");
    let (tmp, path) = put("log.csv", text.as_bytes());
    let out = tmp.path().join("out");
    let call = |flags: &[&str]| {
        planish_testkit::program::stage("planish-import")
            .args(
                [&["trace", &path, "--machine", machine, "--out", out.to_str().unwrap()], flags]
                    .concat(),
            )
            .output()
            .unwrap()
    };
    let output = call(&["--axis", "w=2"]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(said.contains("--axis: the machine has no axis \"w\""), "{said}");
    let output = call(&[]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let loaded = artifact::read::<planish_types::AxesMotion>(&out).unwrap();
    let axes = loaded.manifest.unwrap().outcome["axes"].clone();
    let names: Vec<&str> =
        axes.as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
    let end = loaded.value.position(199, 1e-3);
    let x = 10.0 * (1.0 - (0.1 * std::f64::consts::PI).cos());
    for (name, position) in names.iter().zip(&end) {
        let right = if matches!(*name, "x" | "a") { x } else { 0.6 };
        // Nine decimals of mm and mrad; a mrad is 0.057 deg.
        assert!((position - right).abs() < 1e-7, "{name}: {position}");
    }
    assert_eq!(names.len(), 5);
}
