//! Files that a reader accepts and refuses. Every file is written here byte by byte, as another
//! program would write it. A message names the file, the place, the value and the remedy.

use std::{fs, path::Path};

use crate::support::{
    doubles, longs, npy, removal, save_f8, surface, tif, tool_path, trajectory, varying, write,
    write_bare,
};
use planish_handoff::{
    Artifact, Tool, artifact,
    kind::{self, Kind, MANIFEST},
};
use planish_types::{DwellTime, Removal, Surface, Tif, ToolPath, Trajectory, VaryingTif};
use tempfile::TempDir;

fn tmp() -> TempDir {
    tempfile::tempdir().unwrap()
}

fn refusal<T: Artifact>(dir: &Path) -> String {
    match artifact::read::<T>(dir) {
        Ok(_) => panic!("{} was read", dir.display()),
        Err(e) => e.to_string(),
    }
}

/// Asserts that the message contains every part.
fn says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "no {part:?} in: {message}");
    }
    assert!(!message.contains('\n'), "one line: {message}");
}

#[test]
fn a_tool_that_is_none_is_refused_with_file_and_index() {
    let dir = tmp();
    let tool = |name: &str, shape: &str, values: &[f64]| {
        write_bare(dir.path(), &Tool(varying(true)));
        save_f8(dir.path(), name, shape, values);
        refusal::<Tool>(dir.path())
    };
    let rows = "(2, 3)";
    // Not uniform, and a turn with its end.
    says(
        &tool("azimuth_deg", "(3,)", &[10.0, 135.0, 250.0]),
        &["azimuth_deg", "1", "is 135", "one turn"],
    );
    says(&tool("azimuth_deg", "(3,)", &[0.0, 180.0, 360.0]), &["azimuth_deg", "1", "is 180"]);
    // Factors that turn removal into its opposite: at the third azimuth, where no place of the grid lies, and at a
    // place.
    let opposite = [1.0, 0.75, -1.5, 0.0, 0.0, 0.0];
    says(&tool("azimuth_weight", rows, &opposite), &["azimuth_weight", "[2]", "check kernels"]);
    says(
        &tool("heading_weight", "(2, 2)", &[1.0, -1.0, 0.0, 0.0]),
        &["weight", "[0, 1]", "heading 180 degrees", "check kernels"],
    );
    says(&tool("heading_deg", "(2,)", &[0.0, 90.0]), &["heading_deg", "1", "is 90", "one turn"]);
    let without = |name: &str| {
        write_bare(dir.path(), &Tool(varying(true)));
        fs::remove_file(dir.path().join(format!("{name}.npy"))).unwrap();
        refusal::<Tool>(dir.path())
    };
    says(&without("heading_weight"), &["heading_weight", "is missing beside heading_deg"]);
    says(&without("azimuth_middle_mm"), &["azimuth_middle_mm", "is missing"]);
    let weights = [1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5];
    says(&tool("weight", "(2, 2, 3)", &weights), &["weight", "[1, 2]", "check kernels"]);
}

#[test]
fn every_noun_comes_back_bit_for_bit() {
    let dir = tmp();
    let at = |name: &str| dir.path().join(name);

    write(&at("surface"), &surface());
    let back: Surface = artifact::read(&at("surface")).unwrap().value;
    let bits = |s: &Surface| s.height_nm().iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    assert_eq!((back.grid(), bits(&back)), (surface().grid(), bits(&surface())));

    write(&at("tif"), &tif());
    let back: Tif = artifact::read(&at("tif")).unwrap().value;
    assert_eq!((back.grid(), back.rate_nm_per_s()), (tif().grid(), tif().rate_nm_per_s()));

    // With all factors, with an azimuth alone, and with a heading alone.
    let all = varying(true).numbers();
    let steered = VaryingTif { azimuth: None, pixels: None, time: None, ..all.clone() };
    let tools = [varying(false), varying(true), Tif::varying(steered).unwrap()];
    for (k, tool) in tools.into_iter().enumerate() {
        let dir = at(&format!("tool-{k}"));
        let sent = tool.numbers();
        write(&dir, &Tool(tool));
        let back = artifact::read::<Tool>(&dir).unwrap().value.0.numbers();
        assert_eq!((back.offsets, back.positions), (sent.offsets, sent.positions));
        assert_eq!((back.kernels, back.weights), (sent.kernels, sent.weights));
        assert_eq!((back.azimuth, back.heading), (sent.azimuth, sent.heading));
        assert_eq!((back.pixels, back.time), (sent.pixels, sent.time));
    }

    write(&at("tool_path"), &tool_path());
    assert_eq!(artifact::read::<ToolPath>(&at("tool_path")).unwrap().value, tool_path());

    let dwell = DwellTime::new(vec![0.1, 0.0, 1e-300, 1e9]).unwrap();
    write(&at("dwell"), &dwell);
    assert_eq!(artifact::read::<DwellTime>(&at("dwell")).unwrap().value, dwell);

    write(&at("trajectory"), &trajectory());
    assert_eq!(artifact::read::<Trajectory>(&at("trajectory")).unwrap().value, trajectory());

    write(&at("removal"), &removal());
    let back: Removal = artifact::read(&at("removal")).unwrap().value;
    assert_eq!(back.removal_nm(), removal().removal_nm());
    assert_eq!(bits(back.residual()), bits(removal().residual()));
}

#[test]
fn written_files_are_what_numpy_writes() {
    let dir = tmp();
    write(dir.path().join("p").as_path(), &tool_path());
    let bytes = |name: &str| fs::read(dir.path().join("p").join(name)).unwrap();
    // The format of numpy.lib.format: magic, version 1.0, a header padded to 64 bytes.
    let points = bytes("point_mm.npy");
    assert_eq!(&points[..8], b"\x93NUMPY\x01\x00");
    let header = usize::from(u16::from_le_bytes([points[8], points[9]]));
    assert_eq!((10 + header) % 64, 0);
    let text = std::str::from_utf8(&points[10..10 + header]).unwrap();
    says(text.trim_end(), &["'descr': '<f8'", "'fortran_order': False", "'shape': (4, 2)"]);
    let values: Vec<f64> = tool_path().point_mm().as_flattened().to_vec();
    assert_eq!(points[10 + header..], doubles(&values));
    assert!(String::from_utf8_lossy(&bytes("tool_on.npy")).contains("'descr': '|u1'"));
    assert!(bytes("tool_on.npy").ends_with(&[1, 0, 1]));
    assert!(bytes("pass_idx.npy").ends_with(&longs(&[0, 0, -7])));
}

#[test]
fn a_bare_directory_is_read_with_a_warning_and_defaults() {
    let dir = tmp();
    save_f8(dir.path(), "point_mm", "(3, 2)", &[0.0, 0.0, 1.0, 0.0, 1.0, 2.0]);
    save_f8(dir.path(), "dwell_point_mm", "(2, 2)", &[0.5, 0.0, 1.0, 1.0]);
    let loaded = artifact::read::<ToolPath>(dir.path()).unwrap();
    assert_eq!((loaded.value.tool_on(), loaded.value.pass_idx()), (&[true; 2][..], &[0; 2][..]));
    assert!(loaded.manifest.is_none());
    says(
        &loaded.warning.unwrap(),
        &[
            "no manifest.json",
            "bare arrays of a tool_path",
            "no tool_on.npy, taken as 1",
            "no pass_idx.npy, taken as 0",
        ],
    );
    // A file that is there is not replaced by the default, not even when it cannot be read.
    fs::write(dir.path().join("tool_on.npy"), npy("|b1", false, "(2,)", &[0, 1])).unwrap();
    let loaded = artifact::read::<ToolPath>(dir.path()).unwrap();
    assert_eq!(loaded.value.tool_on(), [false, true]);
    assert!(!loaded.warning.unwrap().contains("tool_on"));
    fs::remove_file(dir.path().join("tool_on.npy")).unwrap();
    std::os::unix::fs::symlink("nowhere", dir.path().join("tool_on.npy")).unwrap();
    says(&refusal::<ToolPath>(dir.path()), &["tool_on.npy: cannot read"]);
}

#[test]
fn the_digest_of_a_bare_directory_is_that_of_the_artifact_with_the_same_arrays() {
    let dir = tmp();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    write(&a, &surface());
    write_bare(&b, &surface());
    let digest = |d: &Path| artifact::read::<Surface>(d).unwrap().digest;
    assert_eq!(digest(&a), digest(&b));
    let mut other = surface().height_nm().clone();
    other[[0, 0]] += 1e-12;
    write_bare(&b, &Surface::new(*surface().grid(), other).unwrap());
    assert_ne!(digest(&a), digest(&b));
}

#[test]
fn foreign_layouts_and_element_types_are_converted_or_name_the_cure() {
    let dir = tmp();
    let six = [1.0, -2.0, 3.0, 4.0, 5.0, 6.0];
    write_bare(dir.path(), &surface());
    save_f8(dir.path(), "height_nm", "(2, 3)", &six);
    let expected = artifact::read::<Surface>(dir.path()).unwrap();
    let columns = [1.0, 4.0, -2.0, 5.0, 3.0, 6.0];
    let big: Vec<u8> = six.iter().flat_map(|v| v.to_be_bytes()).collect();
    let single: Vec<u8> = six.iter().flat_map(|v| (*v as f32).to_le_bytes()).collect();
    for (file, note) in [
        (
            npy("<f8", true, "(2, 3)", &doubles(&columns)),
            "height_nm.npy holds <f8 in Fortran order",
        ),
        (npy(">f8", false, "(2, 3)", &big), "height_nm.npy holds >f8, converted exactly"),
        (npy("<f4", false, "(2, 3)", &single), "height_nm.npy holds <f4, converted exactly"),
        (npy("<i8", false, "(2, 3)", &longs(&six.map(|v| v as i64))), "holds <i8, converted"),
    ] {
        fs::write(dir.path().join("height_nm.npy"), file).unwrap();
        let read = artifact::read::<Surface>(dir.path()).unwrap();
        assert_eq!(read.value.height_nm(), expected.value.height_nm(), "{note}");
        says(&read.warning.unwrap(), &[note]);
    }
    for (file, expected) in [
        (npy("<c16", false, "(2, 3)", &[0; 96]), "is complex (<c16), needs <f8; save a.real"),
        (npy("<f2", false, "(2, 3)", &[0; 12]), "dtype <f2, needs <f8; save a.astype('<f8')"),
        (npy("|O", false, "(2, 3)", &[0; 48]), "dtype |O, needs <f8"),
    ] {
        fs::write(dir.path().join("height_nm.npy"), file).unwrap();
        says(&refusal::<Surface>(dir.path()), &["height_nm.npy: ", expected]);
    }
    // One long axis is the same in both orders, and NumPy says so with Fortran order at times.
    save_f8(dir.path(), "height_nm", "(2, 3)", &six);
    fs::write(dir.path().join("x_mm.npy"), npy("<f8", true, "(3,)", &doubles(&[0.0, 0.5, 1.0])))
        .unwrap();
    artifact::read::<Surface>(dir.path()).unwrap();
    // A file that never ends is not read.
    fs::remove_file(dir.path().join("height_nm.npy")).unwrap();
    std::os::unix::fs::symlink("/dev/zero", dir.path().join("height_nm.npy")).unwrap();
    says(&refusal::<Surface>(dir.path()), &["height_nm.npy: is not a file"]);
}

#[test]
fn wrong_lengths_and_absurd_shapes_are_refused_without_reading_them() {
    let dir = tmp();
    write_bare(dir.path(), &surface());
    let six = doubles(&[1.0; 6]);
    for (shape, expected) in [
        ("(2, 4)", "truncated: shape [2, 4] needs 64 bytes, the file has 48"),
        ("(2, 2)", "16 bytes after the array of shape [2, 2]"),
        ("(1000000000, 1000000000)", "truncated"),
        ("(9223372036854775807, 9223372036854775807)", "impossible shape"),
        ("(99999999999999999999999, 2)", "header"),
        ("(0, 3)", "is empty (shape [0, 3])"),
        ("(-2, -3)", "header"),
        ("(6,)", "has 1 axes (shape [6]), needs 2: (ny, nx)"),
        ("(1, 2, 3)", "has 3 axes (shape [1, 2, 3]), needs 2"),
    ] {
        fs::write(dir.path().join("height_nm.npy"), npy("<f8", false, shape, &six)).unwrap();
        says(&refusal::<Surface>(dir.path()), &["height_nm.npy: ", expected]);
    }
    // A terabyte of nothing after a small array: refused by its header, not read.
    let path = dir.path().join("height_nm.npy");
    fs::write(&path, npy("<f8", false, "(2, 3)", &six)).unwrap();
    match fs::File::options().write(true).open(&path).unwrap().set_len(1 << 40) {
        Ok(()) => says(&refusal::<Surface>(dir.path()), &["bytes after the array of shape [2, 3]"]),
        Err(e) => eprintln!("skipped: no file of a terabyte here ({e})"),
    }
    fs::write(dir.path().join("height_nm.npy"), b"PK\x03\x04").unwrap();
    says(&refusal::<Surface>(dir.path()), &["height_nm.npy: is not a .npy file", "numpy.save"]);
    fs::write(dir.path().join("height_nm.npy"), b"").unwrap();
    says(&refusal::<Surface>(dir.path()), &["height_nm.npy: is empty (0 bytes); write it with"]);
}

#[test]
fn what_is_not_finite_is_named_by_index_and_value() {
    let dir = tmp();
    write_bare(dir.path(), &tif());
    save_f8(dir.path(), "rate_nm_per_s", "(2, 3)", &[1.0, 1.0, 1.0, 1.0, f64::NAN, 1.0]);
    says(
        &refusal::<Tif>(dir.path()),
        &["rate_nm_per_s.npy: element [1, 1] is NaN; give finite values"],
    );
    // NaN marks an invalid pixel of a map; infinity marks nothing.
    write_bare(dir.path(), &surface());
    save_f8(dir.path(), "height_nm", "(2, 3)", &[1.0, f64::NAN, -f64::INFINITY, 0.0, 0.0, 0.0]);
    says(&refusal::<Surface>(dir.path()), &["height_nm.npy: element [0, 2] is -inf", "by NaN"]);
    save_f8(dir.path(), "height_nm", "(2, 3)", &[f64::NAN; 6]);
    says(&refusal::<Surface>(dir.path()), &["height_nm.npy: ", "every pixel is NaN"]);
    save_f8(dir.path(), "dwell_s", "(2,)", &[0.5, -0.25]);
    says(&refusal::<DwellTime>(dir.path()), &["dwell_s.npy: dwell_s[1]: is -0.25 s"]);
    write_bare(dir.path(), &tool_path());
    fs::write(dir.path().join("tool_on.npy"), npy("|u1", false, "(3,)", &[1, 0, 2])).unwrap();
    says(&refusal::<ToolPath>(dir.path()), &["tool_on.npy: element [2] is 2; give 0 or 1"]);
}

#[test]
fn arrays_that_do_not_belong_together_are_named() {
    let dir = tmp();
    write_bare(dir.path(), &surface());
    save_f8(dir.path(), "x_mm", "(4,)", &[0.0, 1.0, 2.0, 3.0]);
    says(
        &refusal::<Surface>(dir.path()),
        &["x_mm.npy: has shape [4], needs (nx) with nx = 3 from height_nm.npy; give arrays"],
    );
    write_bare(dir.path(), &tool_path());
    save_f8(dir.path(), "dwell_point_mm", "(4, 2)", &[0.0; 8]);
    says(
        &refusal::<ToolPath>(dir.path()),
        &["dwell_point_mm.npy: has shape [4, 2], needs (n, 2) with n = 3 from point_mm.npy"],
    );
    save_f8(dir.path(), "point_mm", "(4, 3)", &[0.0; 12]);
    says(&refusal::<ToolPath>(dir.path()), &["point_mm.npy: has shape [4, 3], needs (n+1, 2)"]);
    write_bare(dir.path(), &trajectory());
    save_f8(dir.path(), "break_time_s", "(2,)", &[0.0, 1.0]);
    says(&refusal::<Trajectory>(dir.path()), &["coefficient_mm.npy", "k = 1 from break_time_s"]);
}

#[test]
fn axes_ascend_uniformly_and_times_ascend() {
    let dir = tmp();
    write_bare(dir.path(), &surface());
    for (x, expected) in [
        ([1.0, 0.5, 0.0], "x_mm[1]: is 0.5 after 1; coordinates must ascend; flip the axis"),
        ([0.0, 0.5, 0.5], "x_mm[2]: is 0.5 after 0.5"),
        ([0.0, 0.1, 1.0], "x_mm[2]: is 1 after 0.1, a step of 0.9 mm where the median"),
    ] {
        save_f8(dir.path(), "x_mm", "(3,)", &x);
        says(&refusal::<Surface>(dir.path()), &["x_mm.npy: ", expected]);
    }
    save_f8(dir.path(), "height_nm", "(2, 1)", &[0.0; 2]);
    save_f8(dir.path(), "x_mm", "(1,)", &[0.0]);
    says(&refusal::<Surface>(dir.path()), &["x_mm.npy: ", "at least 2 pixel centres"]);
    write_bare(dir.path(), &trajectory());
    save_f8(dir.path(), "break_time_s", "(3,)", &[0.0, 2.0, 2.0]);
    says(&refusal::<Trajectory>(dir.path()), &["break_time_s.npy: break_time_s[2]: is 2 after 2"]);
}

#[test]
fn flags_in_the_wrong_order_are_said_so() {
    let dir = tmp();
    let path = dir.path().join("t");
    write(&path, &tif());
    says(
        &refusal::<Surface>(&path),
        &["/t: holds a tif, needs a surface; check the order of the flags"],
    );
    // Bare arrays have no kind; the missing file reveals the wrong one.
    write_bare(dir.path().join("b").as_path(), &tif());
    says(
        &refusal::<Surface>(&dir.path().join("b")),
        &["height_nm.npy: is missing; a surface needs height_nm as <f8 (see docs/formats.md)"],
    );
}

/// Changes the manifest of a new dwell artifact and returns the message of the reader.
fn with_manifest(change: impl FnOnce(String) -> String) -> String {
    let dir = tmp();
    let path = dir.path().join("d");
    write(&path, &DwellTime::new(vec![1.0, 2.0]).unwrap());
    let manifest = path.join(MANIFEST);
    let text = fs::read_to_string(&manifest).unwrap();
    let changed = change(text.clone());
    assert_ne!(text, changed);
    fs::write(manifest, changed).unwrap();
    refusal::<DwellTime>(&path)
}

#[test]
fn a_newer_version_is_refused_even_when_its_manifest_looks_different() {
    let newer = "dwell version 2 is newer than this program knows (1); update Planish";
    says(&with_manifest(|m| m.replace("\"version\": 1", "\"version\": 2")), &[newer]);
    says(&with_manifest(|_| r#"{"kind": "dwell", "version": 2, "new": []}"#.into()), &[newer]);
}

#[test]
fn a_damaged_manifest_is_refused() {
    let remedy = "make the artifact again";
    says(&with_manifest(|m| m[..m.len() / 2].into()), &["manifest.json: is not a man", remedy]);
    says(&with_manifest(|_| String::new()), &["manifest.json: is not a manifest", remedy]);
    says(&with_manifest(|_| "[]".into()), &["manifest.json: is not a manifest", remedy]);
    says(&with_manifest(|_| "[".repeat(100_000)), &["manifest.json: is not a manifest", remedy]);
    // A manifest whose seal is whole was written by Planish; one without a seal is checked key by key.
    let edited = with_manifest(|m| m.replace("\"blake3\"", "\"sha\""));
    says(&edited, &["manifest.json: was changed after it was written", remedy]);
    let unsealed = |m: &str| m.replace("\"seal\"", "\"note\"");
    let without_hash = with_manifest(|m| unsealed(&m).replace("\"blake3\"", "\"sha\""));
    says(&without_hash, &["missing field", remedy]);
    let other_array = with_manifest(|m| unsealed(&m).replace("dwell_s\": {", "x\": {"));
    says(&other_array, &["is not listed", remedy]);
}

#[test]
fn a_changed_array_is_noticed() {
    let dir = tmp();
    let path = dir.path().join("d");
    write(&path, &DwellTime::new(vec![1.0, 2.0]).unwrap());
    save_f8(&path, "dwell_s", "(2,)", &[1.0, 2.0 + f64::EPSILON * 2.0]);
    says(
        &refusal::<DwellTime>(&path),
        &["dwell_s.npy: was changed after it was written (BLAKE3 ", "remove manifest.json to use"],
    );
    save_f8(&path, "dwell_s", "(3,)", &[1.0, 2.0, 3.0]);
    says(&refusal::<DwellTime>(&path), &["has shape [3] but manifest.json says [2]"]);
    fs::remove_file(path.join(MANIFEST)).unwrap();
    assert_eq!(artifact::read::<DwellTime>(&path).unwrap().value.dwell_s(), [1.0, 2.0, 3.0]);
}

#[test]
fn a_missing_array_of_an_artifact_is_not_defaulted() {
    let dir = tmp();
    let path = dir.path().join("p");
    write(&path, &tool_path());
    fs::remove_file(path.join("tool_on.npy")).unwrap();
    says(&refusal::<ToolPath>(&path), &["tool_on.npy: is missing; a tool_path needs tool_on"]);
}

#[test]
fn what_is_not_a_readable_directory_is_named() {
    let dir = tmp();
    let file = dir.path().join("file");
    fs::write(&file, "x").unwrap();
    let remedy = "give a surface directory (see docs/formats.md)";
    says(&refusal::<Surface>(&file), &["file: is not a directory", remedy]);
    says(&refusal::<Surface>(&file.join("below")), &["below: cannot be read: ", remedy]);
    says(&refusal::<Surface>(&dir.path().join("no")), &["no: does not exist", remedy]);
    let long = dir.path().join("n".repeat(300));
    says(&refusal::<Surface>(&long), &["cannot be read: ", "too long", remedy]);
    let link = dir.path().join("loop");
    std::os::unix::fs::symlink("loop", &link).unwrap();
    says(&refusal::<Surface>(&link), &["loop: cannot be read: ", remedy]);
    fs::create_dir_all(dir.path().join("s/height_nm.npy")).unwrap();
    says(&refusal::<Surface>(&dir.path().join("s")), &["height_nm.npy: is not a file"]);
}

#[test]
fn nobody_reads_what_the_permissions_forbid() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tmp();
    let parent = dir.path().join("parent");
    write(&parent.join("s"), &surface());
    fs::set_permissions(&parent, fs::Permissions::from_mode(0o000)).unwrap();
    let message = match artifact::read::<Surface>(&parent.join("s")) {
        Ok(_) => {
            eprintln!("skipped: this user may read everything");
            String::new()
        }
        Err(e) => e.to_string(),
    };
    fs::set_permissions(&parent, fs::Permissions::from_mode(0o700)).unwrap();
    if !message.is_empty() {
        says(&message, &["s: cannot be read: ", "denied", "give a surface directory"]);
    }
}

#[test]
fn every_kind_has_unique_names_and_known_shapes() {
    for kind in kind::ALL {
        let Kind { name, arrays, .. } = kind;
        for (i, a) in arrays.iter().enumerate() {
            assert!(arrays[..i].iter().all(|b| b.name != a.name), "{name}");
            assert_eq!(a.shape.len(), a.axes.len(), "{name}/{}", a.name);
            // The unit is in the name wherever there is one.
            let plain = a.unit == "1" || a.name.starts_with("coefficient_mm");
            let unit = a.unit.replace("1/", "per_").replace('/', "_per_");
            let unit = unit.replace('^', "").replace(' ', "_");
            assert!(plain || a.name.ends_with(&format!("_{unit}")), "{name}/{}", a.name);
        }
    }
}
