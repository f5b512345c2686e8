//! Hostile input: files that ask for much, absurd numbers in every numeric flag, maps that are hardly maps,
//! and files of no format. The program must end in time and within its memory, with an exit code of the
//! table and at most one message, never with an internal error.

use std::{
    fs,
    path::Path,
    process::{Command, Output},
    time::{Duration, Instant},
};

use flate2::{Compress, Compression, FlushCompress};
use planish_testkit::program::run_within;
use planish_types::ControllerKind;
use serde_json::Value;

/// Longest time for one run, s. Larger: the test finds an endless loop later. Smaller: it fails on a busy
/// machine. Chosen: a run takes milliseconds, on a compressed bomb less than a second.
const LIMIT: Duration = Duration::from_secs(20);

/// Address space of a run, KiB. Larger: the test does not find a large allocation. Smaller: the allocator
/// fails, which sets 1 GiB aside and uses little of it; the program and its threads take 100 MiB each.
const ADDRESS_SPACE_KIB: usize = 1_700_000;

/// Runs the program to its end, or stops it after [`LIMIT`].
fn run(dir: &Path, arguments: &[&str]) -> Output {
    let line = format!("ulimit -v {ADDRESS_SPACE_KIB}; exec \"$@\"");
    let mut command = Command::new("sh");
    command.args(["-c", &line, "sh"]).arg(planish_testkit::program::planish());
    command.arg("planish-import").args(arguments);
    run_within(command.current_dir(dir), LIMIT)
}

/// Runs the program, and checks that the exit code is 2, the message has one line, and nothing is written. Returns that
/// line.
fn refused(dir: &Path, arguments: &[&str]) -> String {
    let output = run(dir, &[arguments, &["--out", "refused"]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
    assert!(said.starts_with("error: ") && said.lines().count() == 1, "{arguments:?}: {said}");
    assert!(!dir.join("refused").exists(), "{arguments:?}");
    said
}

fn done(dir: &Path, arguments: &[&str]) {
    let _ = fs::remove_dir_all(dir.join("out"));
    let output = run(dir, &[arguments, &["--out", "out"]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {said}");
}

const NM: [&str; 4] = ["--unit", "nm", "--pixel-mm", "1"];

#[test]
fn pipes_and_devices_are_refused() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    assert!(Command::new("mkfifo").arg(dir.join("pipe")).status().unwrap().success());
    fs::write(dir.join("a.csv"), "1,2\n3,4\n").unwrap();
    fs::write(dir.join("p.trj"), "0.1, 1, 0, 0, 0\n").unwrap();
    for path in ["pipe", "/dev/zero", "/dev/stdin"] {
        let dwell = ["--dwell-s", "1", "--half-size-mm", "1"];
        let program = ["program", "p.trj", "--controller", "xps", "--about", path];
        for arguments in [
            [&["surface", path], &NM[..]].concat(),
            vec!["surface", path, "--format", "csv"],
            vec!["surface", path, "--format", "hdf5"],
            [&["tif", path, "--rate"], &NM[..]].concat(),
            [&["tif", "a.csv", "--before", path], &dwell[..], &NM[..]].concat(),
            vec!["program", path, "--controller", "gcode"],
            vec!["trace", path, "--format", "csv"],
            program.to_vec(),
        ] {
            let said = refused(dir, &arguments);
            assert!(
                said.contains(path) && said.contains("is not a file; give a regular file"),
                "{said}"
            );
        }
    }
    let said = refused(dir, &["program", ".", "--controller", "xps"]);
    assert!(said.contains("is not a file; give a regular file"), "{said}");
}

#[test]
fn an_empty_file_is_called_empty() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    for name in ["a", "a.csv", "a.xyz", "a.npy", "a.dat", "a.datx", "a.mat", "a.h5", "a.fits"] {
        fs::write(dir.join(name), "").unwrap();
        let said = refused(dir, &["surface", name]);
        assert!(said.contains(&format!("{name}: is empty; export it again")), "{said}");
    }
    for format in ["metropro", "datx", "xyz", "mat5", "hdf5", "fits", "csv", "npy", "sdf"] {
        let said = refused(dir, &["tif", "a", "--rate", "--format", format]);
        assert!(said.contains("a: is empty"), "{format}: {said}");
    }
    for format in ["csv", "hdf5", "xps", "aerotech", "galil"] {
        let said = refused(dir, &["trace", "a", "--format", format]);
        assert!(said.contains("a: is empty"), "{format}: {said}");
    }
    for controller in ControllerKind::ALL.map(ControllerKind::name) {
        let said = refused(dir, &["program", "a", "--controller", controller]);
        assert!(said.contains("a: is empty"), "{controller}: {said}");
    }
    fs::write(dir.join("a"), "# only a comment\n\n").unwrap();
    assert!(refused(dir, &["surface", "a", "--format", "csv"]).contains("holds no numbers"));
    assert!(refused(dir, &["surface", "a", "--format", "xyz"]).contains("holds no points"));
}

/// Returns an HDF5 file of the first layout whose root group holds `names` links, all to itself. It has `names`^6 paths
/// of six names.
fn cycle(names: u64) -> Vec<u8> {
    const UNDEFINED: u64 = u64::MAX;
    let (root, tree, heap, text) = (96_u64, 136_u64, 680_u64, 712_u64);
    let nodes = text + 8 * (names + 1);
    let end = nodes + 8 + 40 * names;
    let entry = |name: u64, header: u64| {
        [[name, header, 0].map(u64::to_le_bytes).concat(), vec![0; 16]].concat()
    };
    let mut b = b"\x89HDF\r\n\x1a\n\x00\x00\x00\x00\x00\x08\x08\x00".to_vec();
    b.extend([4, 0, 16, 0, 0, 0, 0, 0]);
    b.extend([0, UNDEFINED, end, UNDEFINED].map(u64::to_le_bytes).concat());
    b.extend(entry(0, root));
    // Object header of version 1 with the message "symbol table".
    b.extend([1, 0, 1, 0, 1, 0, 0, 0, 24, 0, 0, 0, 0, 0, 0, 0]);
    b.extend([0x11, 0, 16, 0, 0, 0, 0, 0]);
    b.extend([tree, heap].map(u64::to_le_bytes).concat());
    assert_eq!(b.len() as u64, tree);
    b.extend(b"TREE\x00\x00\x01\x00");
    b.extend([UNDEFINED, UNDEFINED, 0, nodes, 8 * names].map(u64::to_le_bytes).concat());
    b.resize(heap as usize, 0);
    b.extend(b"HEAP\x00\x00\x00\x00");
    b.extend([8 * (names + 1), UNDEFINED, text].map(u64::to_le_bytes).concat());
    b.extend([0; 8]);
    b.extend((0..names).flat_map(|i| format!("g{i:06}\0").into_bytes()));
    assert_eq!(b.len() as u64, nodes);
    b.extend(b"SNOD\x01\x00");
    b.extend((names as u16).to_le_bytes());
    b.extend((1..=names).flat_map(|i| entry(8 * i, root)));
    b
}

#[test]
fn a_group_that_contains_itself_is_listed_once() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    fs::write(dir.join("a.h5"), cycle(60)).unwrap();
    let said = refused(dir, &["surface", "a.h5"]);
    assert!(said.contains("holds no matrix of real numbers"), "{said}");
    let deep = ["g000001"; 500].join("/");
    let said = refused(dir, &["surface", "a.h5", "--dataset", &deep]);
    assert!(said.contains("dataset not found"), "{said}");
    // More names than a group of an instrument ever has.
    fs::write(dir.join("b.h5"), cycle(6000)).unwrap();
    let said = refused(dir, &["surface", "b.h5"]);
    assert!(said.contains("points to and fro: too many names"), "{said}");
}

fn element(kind: u32, data: &[u8]) -> Vec<u8> {
    let mut b = kind.to_le_bytes().to_vec();
    b.extend((data.len() as u32).to_le_bytes());
    b.extend(data);
    b.resize(b.len().next_multiple_of(8), 0);
    b
}

/// Returns a MATLAB matrix of doubles as an element of a file; with `flags` 8 it is complex.
fn matrix(name: &str, rows: i32, columns: i32, flags: u8, data: &[u8]) -> Vec<u8> {
    let sizes = [rows.to_le_bytes(), columns.to_le_bytes()].concat();
    let head = element(6, &[6, flags, 0, 0, 0, 0, 0, 0]);
    let mut inside =
        [head, element(5, &sizes), element(1, name.as_bytes()), element(9, data)].concat();
    if flags & 8 != 0 {
        inside.extend(element(9, data));
    }
    element(14, &inside)
}

fn mat(elements: &[Vec<u8>]) -> Vec<u8> {
    let mut b = b"MATLAB 5.0 MAT-file, made by a test".to_vec();
    b.resize(124, b' ');
    b.extend([0, 1, b'I', b'M']);
    b.extend(elements.concat());
    b
}

fn deflated(data: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(data.len() / 500 + 10_000);
    let mut stream = Compress::new(Compression::best(), true);
    stream.compress_vec(data, &mut out, FlushCompress::Finish).unwrap();
    [15_u32.to_le_bytes().to_vec(), (out.len() as u32).to_le_bytes().to_vec(), out].concat()
}

fn doubles(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

#[test]
fn bombs_are_not_inflated() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let z = matrix("Z", 2, 3, 0, &doubles(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
    // 80 MB of zeros in 80 kB, 200 times: 16 GB.
    let zeros = vec![0; 80 << 20];
    let bomb = deflated(&matrix("bomb", 1, 10 << 20, 0, &zeros));
    let nameless = deflated(&zeros);
    let mut elements = vec![bomb; 100];
    elements.extend(vec![nameless; 100]);
    elements.push(z.clone());
    fs::write(dir.join("a.mat"), mat(&elements)).unwrap();
    let started = Instant::now();
    done(dir, &[&["surface", "a.mat"], &NM[..]].concat());
    // 0.01 s here; to inflate them all takes a minute.
    assert!(started.elapsed() < Duration::from_secs(5), "{:?}", started.elapsed());
    // The map itself goes on for 80 MB after its 48 bytes.
    let long = [z.clone(), zeros].concat();
    fs::write(dir.join("b.mat"), mat(&[deflated(&long)])).unwrap();
    let said = refused(dir, &[&["surface", "b.mat"], &NM[..]].concat());
    assert!(said.contains("grows beyond the 112 bytes of \"Z\""), "{said}");
    // More variables than anybody saves.
    fs::write(dir.join("c.mat"), mat(&vec![element(99, &[]); 20_000])).unwrap();
    let said = refused(dir, &[&["surface", "c.mat"], &NM[..]].concat());
    assert!(said.contains("more than 10000 variables"), "{said}");
    // A map that is larger than what the program may take.
    let large = matrix("Z", 2000, 2000, 0, &vec![0; 32_000_000]);
    fs::write(dir.join("d.mat"), mat(&[deflated(&large)])).unwrap();
    let small = ["surface", "d.mat", "--memory-gib", "0.125"];
    let said = refused(dir, &[&small, &NM[..]].concat());
    assert!(said.contains("GiB of the 0.125 GiB") && said.contains("crop it"), "{said}");
    done(dir, &[&["surface", "d.mat"], &NM[..]].concat());
}

#[test]
fn long_texts_are_not_collected() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let small = ["--memory-gib", "0.25"];
    fs::write(dir.join("a.csv"), ",".repeat(12_000_000)).unwrap();
    let said = refused(dir, &[&["surface", "a.csv"], &small[..], &NM].concat());
    assert!(said.contains("CSV file: would have"), "{said}");
    let fields = refused(dir, &["surface", "a.csv", "--format", "xyz"]);
    assert!(fields.contains("fields in line 1, not x y z"), "{fields}");
    fs::write(dir.join("a.xyz"), "1 2 3\n".repeat(4_000_000)).unwrap();
    let said = refused(dir, &[&["surface", "a.xyz"], &small[..], &NM].concat());
    assert!(said.contains("XYZ file: would have"), "{said}");
    fs::write(dir.join("a.sdf"), format!("aISO-1.0\n{}", "a=\n".repeat(10_000_000))).unwrap();
    assert!(refused(dir, &["surface", "a.sdf"]).contains("more than 50000 lines of its header"));
    let card = |text: &str| format!("{text:<80}");
    let mut fits = [card("SIMPLE  = T"), card("BITPIX  = 8"), card("NAXIS   = 999")].concat();
    (0..600_000).for_each(|i| fits += &card(&format!("K{i:<7}= 1")));
    fs::write(dir.join("a.fits"), fits).unwrap();
    assert!(refused(dir, &["surface", "a.fits"]).contains("more than 50000 cards in a header"));
}

#[test]
fn complex_numbers_and_rounded_integers_are_refused_by_name() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let npy = |descriptor: &str, data: Vec<u8>| {
        let header =
            format!("{{'descr': '{descriptor}', 'fortran_order': False, 'shape': (2, 2), }}");
        [b"\x93NUMPY\x01\x00\x76\x00", format!("{header:<117}\n").as_bytes(), &data].concat()
    };
    fs::write(dir.join("c.npy"), npy("<c16", vec![0; 64])).unwrap();
    let said = refused(dir, &[&["surface", "c.npy"], &NM[..]].concat());
    assert!(said.contains("complex numbers of type \"<c16\""), "{said}");
    let integers = |v: i64| [1, 2, 3, v].iter().flat_map(|v| v.to_le_bytes()).collect();
    fs::write(dir.join("i.npy"), npy("<i8", integers((1 << 53) + 1))).unwrap();
    let said = refused(dir, &[&["surface", "i.npy"], &NM[..]].concat());
    assert!(said.contains("stored value[3]: is a 64-bit integer beyond 2^53"), "{said}");
    fs::write(dir.join("i.npy"), npy("<i8", integers(1 << 33))).unwrap();
    done(dir, &[&["surface", "i.npy"], &NM[..]].concat());

    let data = doubles(&[1.0, 2.0, 3.0, 4.0]);
    fs::write(dir.join("c.mat"), mat(&[matrix("Z", 2, 2, 8, &data)])).unwrap();
    for dataset in [&[][..], &["--dataset", "Z"]] {
        let said = refused(dir, &[&["surface", "c.mat"], &NM[..], dataset].concat());
        assert!(said.contains("holds complex numbers in \"Z\""), "{said}");
    }
    fs::write(dir.join("c.csv"), "1,2\n3,4+5j\n").unwrap();
    let said = refused(dir, &[&["surface", "c.csv"], &NM[..]].concat());
    assert!(said.contains("\"4+5j\" in line 2, field 2") && said.contains("complex"), "{said}");
}

#[test]
fn an_axis_that_jumps_names_the_place_and_both_steps() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let x = [0.0, 1.0, 2.0, 3.5, 4.5];
    let z: Vec<f64> = (0..10).map(f64::from).collect();
    fs::write(
        dir.join("a.mat"),
        mat(&[
            matrix("Z", 2, 5, 0, &doubles(&z)),
            matrix("X", 1, 5, 0, &doubles(&x)),
            matrix("Y", 1, 2, 0, &doubles(&[1.0, 0.0])),
        ]),
    )
    .unwrap();
    let said = refused(dir, &["surface", "a.mat", "--unit", "nm", "--coordinate-unit", "mm"]);
    let expected = "x[3]: is 3.5 after 2, a step of 1.5 mm where the median step is 1 mm";
    assert!(said.contains(expected), "{said}");
    let lines = |y: f64| x.map(|x| format!("{x} {y} 1\n")).concat();
    fs::write(dir.join("a.xyz"), lines(0.0) + &lines(1.0)).unwrap();
    let units = ["--unit", "nm", "--coordinate-unit", "mm"];
    let said = refused(dir, &[&["surface", "a.xyz"], &units[..]].concat());
    let expected = "x: has 3.5 after 2: a step of 1.5, where the usual step is 1";
    assert!(said.contains(expected), "{said}");
    // A column that nobody measured is a hole, not a jump.
    fs::write(
        dir.join("a.xyz"),
        (lines(0.0) + &lines(1.0)).replace("3.5", "4").replace("4.5", "5"),
    )
    .unwrap();
    done(dir, &[&["surface", "a.xyz"], &units[..]].concat());
}

#[test]
fn no_message_makes_a_terminal_do_anything() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    fs::write(dir.join("a.csv"), "1,\x1b[2J\x07\n").unwrap();
    let said = refused(dir, &[&["surface", "a.csv"], &NM[..]].concat());
    assert!(!said.contains('\x1b') && !said.contains('\x07'), "{said:?}");
    fs::write(dir.join("a.trj"), "0.1, \x1b]0;title\x07, 0, 0, 0\n").unwrap();
    let program = ["program", "a.trj", "--controller", "xps", "--start-mm", "0"];
    let said = refused(dir, &program);
    assert!(!said.contains('\x1b') && said.contains("\\u{1b}"), "{said:?}");
}

const NUMBERS: [&str; 14] = [
    "0",
    "-0",
    "-1",
    "nan",
    "inf",
    "-inf",
    "1e-300",
    "1e-9",
    "1e9",
    "1e300",
    "1000000",
    "9007199254740993",
    "18446744073709551615",
    "99999999999999999999",
];

/// Appends to `found` the paths at which a JSON value is null, because JSON writes NaN and infinity as null.
fn nulls(value: &Value, at: &str, found: &mut Vec<String>) {
    match value {
        Value::Null => found.push(at.into()),
        Value::Array(all) => all.iter().for_each(|v| nulls(v, &format!("{at}[]"), found)),
        Value::Object(all) => all.iter().for_each(|(k, v)| nulls(v, &format!("{at}.{k}"), found)),
        _ => {}
    }
}

/// Runs a command on hostile input. Returns the fault in its end, if any, and true if it did not refuse the input.
fn judged(dir: &Path, arguments: &[&str]) -> (Option<String>, bool) {
    let _ = fs::remove_dir_all(dir.join("out"));
    let _ = fs::remove_file(dir.join("p.svg"));
    let picture: &[&str] = if arguments[0] == "program" { &[] } else { &["--picture", "p.svg"] };
    let output = run(dir, &[arguments, picture, &["--out", "out"]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    let errors = said.lines().filter(|l| l.starts_with("error: ")).count();
    let wrong = match output.status.code() {
        _ if said.contains("internal error") || said.contains("panicked") => Some(said),
        Some(0 | 1) => {
            let text = fs::read_to_string(dir.join("out/manifest.json")).unwrap();
            let manifest: Value = serde_json::from_str(&text).unwrap();
            let mut found = Vec::new();
            nulls(&manifest["outcome"], "", &mut found);
            // What formats of bare numbers state, and a spot where none was cut.
            found.retain(|n| n != ".reading.stated" && n != ".spot");
            let svg = fs::read_to_string(dir.join("p.svg")).unwrap_or_default();
            let drawn = svg.contains("NaN") || svg.contains("inf\"");
            (!found.is_empty() || drawn).then(|| format!("null in {found:?}, NaN drawn: {drawn}"))
        }
        Some(2) if errors != 1 => Some(format!("{errors} messages: {said}")),
        Some(2) if dir.join("out").exists() => Some(format!("wrote: {said}")),
        Some(2) if dir.join("p.svg").exists() => Some(format!("drew: {said}")),
        Some(2) => None,
        other => Some(format!("ended with {other:?}: {said}")),
    };
    (wrong, output.status.code() != Some(2))
}

/// Commands with a `?` in place of a number that the test replaces by hostile ones, each with a usual number.
const FLAGS: [(&str, &str); 24] = [
    ("surface a.csv --unit waves --pixel-mm 1 --wavelength-nm ?", "632.8"),
    ("surface a.csv --unit nm --pixel-mm ?", "0.5"),
    ("surface a.csv --unit nm --pixel-mm 1,?", "0.5"),
    ("surface a.csv --unit nm --pixel-mm ?,1 --rotate-deg 90 --origin centre", "0.5"),
    ("surface a.csv --unit m --pixel-mm 1 --surface-per-value ?", "1e-9"),
    ("surface a.csv --unit nm --pixel-mm 1 --surface-per-value ?", "0.5"),
    ("surface a.csv --unit nm --pixel-mm 1 --no-data ?", "3"),
    ("surface a.csv --unit nm --pixel-mm 1 --memory-gib ?", "1"),
    ("tif t.csv --unit nm --rate --pixel-mm ?", "0.5"),
    ("tif t.csv --unit nm --rate --pixel-mm 1 --surface-per-value ?", "0.5"),
    ("tif t.csv --unit nm --rate --pixel-mm 1 --no-data ?", "3"),
    ("tif t.csv --unit nm --pixel-mm 1 --half-size-mm 3 --dwell-s ?", "30"),
    ("tif t.csv --unit nm --pixel-mm 1 --dwell-s 30 --half-size-mm ?", "3"),
    (
        "tif t.csv --unit nm --pixel-mm 1 --dwell-s 30 --half-size-mm 3 --baseline none --spot-mm ?",
        "8",
    ),
    ("tif t.csv --unit nm --pixel-mm 1 --dwell-s 30 --half-size-mm 3 --spot-mm 8,?", "8"),
    ("tif t.csv --unit nm --dwell-s 30 --half-size-mm 3 --baseline piston --pixel-mm ?", "1"),
    ("tif t.csv --before z.csv --unit nm --pixel-mm 1 --dwell-s 30 --half-size-mm ? --negate", "3"),
    (
        "tif s.csv --before w.csv --align shift --unit nm --pixel-mm 1 --dwell-s ? --half-size-mm 3",
        "3",
    ),
    ("program p.trj --controller xps --start-mm ?", "1"),
    ("program p.trj --controller xps --start-mm 1,?", "1"),
    ("program p.dmc --controller galil --start-mm 0 --sample-s 1e-3 --count-mm ?", "1e-3"),
    ("program p.dmc --controller galil --start-mm 0 --count-mm 1e-3 --sample-s ?", "1e-3"),
    ("program p.dmc --controller galil --count-mm 1e-3 --sample-s 1e-3 --start-mm ?", "1e-3"),
    ("program p.pmc --controller pmac --start-mm 0 --feedrate-time-unit-s ?", "1"),
];

fn inputs(dir: &Path) {
    let text = |f: &dyn Fn(f64, f64) -> f64| -> String {
        let line = |r: i32| (0..17).map(move |c| f(f64::from(c), f64::from(r)).to_string());
        (0..17).map(|r| line(r).collect::<Vec<_>>().join(",") + "\n").collect()
    };
    let waves = |x: f64, y: f64| (1.1 * x + 0.3 * y).sin() + (0.7 * y - 0.2 * x).cos();
    let spot = |x: f64, y: f64| 240.0 * (-((x - 8.0).powi(2) + (y - 8.0).powi(2)) / 2.0).exp();
    fs::write(dir.join("a.csv"), "1,2,3\n4,nan,6\n7,8,10\n").unwrap();
    fs::write(dir.join("t.csv"), text(&spot)).unwrap();
    fs::write(dir.join("z.csv"), text(&|_, _| 0.0)).unwrap();
    fs::write(dir.join("w.csv"), text(&waves)).unwrap();
    // What the spot left of the waves: the two maps can be aligned.
    fs::write(dir.join("s.csv"), text(&|x, y| waves(x, y) - spot(x, y))).unwrap();
    fs::write(dir.join("p.trj"), "0.1, 1, 0.5, 0, 0\n0.2, 0, 0, 0, 0\n").unwrap();
    let galil = "PVA=0,0,-1\nPVB=0,0,-1\nPVA=100,5,100\nPVB=0,0,100\nPVA=0,0,0\nPVB=0,0,0\nBTAB\n";
    fs::write(dir.join("p.dmc"), galil).unwrap();
    fs::write(dir.join("p.pmc"), "ABS\nPVT100\nX2:3 Y-2:1\nPVT200\nX2:0 Y-2:0\n").unwrap();
}

#[test]
fn absurd_numbers_end_with_a_result_or_a_message() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    inputs(dir);
    let mut failures = Vec::new();
    for (flags, usual) in FLAGS {
        let with = |number: &str| flags.replace('?', number);
        let call = |line: &str| judged(dir, &line.split(' ').collect::<Vec<_>>());
        let (wrong, ran) = call(&with(usual));
        if wrong.is_some() || !ran {
            failures.push(format!("usual {}: ran {ran}, {wrong:?}", with(usual)));
        }
        for number in NUMBERS {
            if let (Some(wrong), _) = call(&with(number)) {
                failures.push(format!("{}: {wrong}", with(number)));
            }
        }
    }
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}

#[test]
fn maps_that_are_hardly_maps_end_with_a_result_or_a_message() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    inputs(dir);
    let nan = "nan,nan,nan\n".repeat(3);
    let maps = [
        ("one-pixel", "5\n".to_string()),
        ("one-row", "1,2,3\n".into()),
        ("one-column", "1\n2\n3\n".into()),
        ("all-nan", nan.clone()),
        ("one-valid-pixel", format!("{nan}nan,3,nan\n{nan}")),
        ("one-valid-row", format!("{nan}1,2,3\n")),
        ("constant", "7,7,7\n".repeat(3)),
        ("zero", "0,0,0\n".repeat(3)),
        ("large", "1e12,-1e12\n-1e12,1e12\n".into()),
        ("too-large", "1e300,1\n2,3\n".into()),
        ("infinite", "inf,1\n2,3\n".into()),
        ("small", "1e-300,2e-300\n0,5e-324\n".into()),
        ("two-by-two", "1,2\n3,4\n".into()),
    ];
    let calls = [
        "surface m.csv --unit nm --pixel-mm 1",
        "surface m.csv --unit m --pixel-mm 1e-9",
        "surface m.csv --unit nm --pixel-mm 1 --rotate-deg 270 --flip-x --origin centre",
        "tif m.csv --unit nm --rate --pixel-mm 1",
        "tif m.csv --unit nm --pixel-mm 1 --dwell-s 30 --half-size-mm 1",
        "tif m.csv --unit nm --pixel-mm 1 --dwell-s 30 --half-size-mm 1 --baseline none --clip-negative",
        "tif m.csv --before m.csv --unit nm --pixel-mm 1 --dwell-s 30 --half-size-mm 1 --align shift",
    ];
    let mut failures = Vec::new();
    let (mut done, mut refused) = (0, 0);
    for (name, text) in &maps {
        fs::write(dir.join("m.csv"), text).unwrap();
        for line in calls {
            let (wrong, ran) = judged(dir, &line.split(' ').collect::<Vec<_>>());
            (done, refused) = (done + usize::from(ran), refused + usize::from(!ran));
            if let Some(wrong) = wrong {
                failures.push(format!("{name}: {line}: {wrong}"));
            }
        }
    }
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
    assert!(done > 10 && refused > 10, "{done} done, {refused} refused");
}

#[test]
fn absurd_numbers_for_a_log_end_in_one_message() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    let line = |i: i32| format!("{i},{},{},{},1\n", i * i, 3 * i, 2.0);
    let log: String = ["t_ms,x_um,y_um,current,tool_on\n".to_string()]
        .into_iter()
        .chain((0..40).map(line))
        .collect();
    fs::write(dir.join("log.csv"), log).unwrap();
    let base = ["trace", "log.csv", "--nominal-current", "2"];
    done(dir, &base);
    for value in ["0", "-1", "nan", "inf", "1e-300", "1e300", "1e9"] {
        for flag in [
            "--rate-hz",
            "--sample-s",
            "--most-gap-s",
            "--count-mm",
            "--from-s",
            "--until-s",
            "--most-offset-s",
        ] {
            let flag = format!("{flag}={value}");
            let arguments = [&base[..], &[flag.as_str(), "--force", "--out", "out"]].concat();
            let output = run(dir, &arguments);
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            let errors = said.lines().filter(|l| l.starts_with("error: ")).count();
            let code = output.status.code();
            assert!(matches!(code, Some(0 | 2)) && !said.contains("internal"), "{flag}: {said}");
            assert_eq!(errors, usize::from(code == Some(2)), "{flag}: {said}");
            if code == Some(0) {
                let manifest = fs::read_to_string(dir.join("out/manifest.json")).unwrap();
                assert!(!manifest.split("\"outcome\"").nth(1).unwrap().contains("null"), "{flag}");
            }
        }
    }
}
