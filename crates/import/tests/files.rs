//! Files of every format, made here byte by byte from the descriptions of the formats; bad ones; and
//! random damage to all of them. Files made by other writers: `just test-interop`.
//!
//! `PLANISH_FUZZ_EXECUTIONS` sets how many damaged files each reader sees (default 1000).

use std::panic;

use flate2::{Compress, Compression, FlushCompress};
use ndarray::{Array2, array};
use planish_import::{
    FirstRow, Format, Pick, ReadingSettings, Rotation, Unit,
    program::{self, Configuration},
    read, surface,
};
use planish_types::ControllerKind;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Returns 2 x 3 stored values, all different.
fn raw() -> Array2<f64> {
    array![[1.0, -2.0, 3.0], [40.0, 50.0, -60.0]]
}

fn metropro(rows: u16, columns: u16, phase: &[i32]) -> Vec<u8> {
    let mut b = vec![0; 834];
    b[..4].copy_from_slice(&0x881B_036F_u32.to_be_bytes());
    b[4..6].copy_from_slice(&1_u16.to_be_bytes());
    b[6..10].copy_from_slice(&834_u32.to_be_bytes());
    // Four pixels of intensity.
    b[60..64].copy_from_slice(&8_u32.to_be_bytes());
    b[68..70].copy_from_slice(&columns.to_be_bytes());
    b[70..72].copy_from_slice(&rows.to_be_bytes());
    b[72..76].copy_from_slice(&(4 * u32::from(rows) * u32::from(columns)).to_be_bytes());
    for (at, v) in [(164, 0.5_f32), (168, 6.328e-7), (176, 1.0), (184, 1.5e-4)] {
        b[at..at + 4].copy_from_slice(&v.to_be_bytes());
    }
    b[218..220].copy_from_slice(&1_i16.to_be_bytes());
    b.extend([7; 8]);
    b.extend(phase.iter().flat_map(|v| v.to_be_bytes()));
    b
}

fn npy(descriptor: &str, shape: &str, fortran: bool, data: &[u8]) -> Vec<u8> {
    let fortran = if fortran { "True" } else { "False" };
    let mut header =
        format!("{{'descr': '{descriptor}', 'fortran_order': {fortran}, 'shape': {shape}, }}");
    while !(header.len() + 11).is_multiple_of(64) {
        header.push(' ');
    }
    header.push('\n');
    let mut b = b"\x93NUMPY\x01\x00".to_vec();
    b.extend((header.len() as u16).to_le_bytes());
    b.extend(header.as_bytes());
    b.extend(data);
    b
}

fn fits(cards: &[&str], data: &[u8]) -> Vec<u8> {
    let mut b = Vec::new();
    for card in cards.iter().chain(&["END"]) {
        b.extend(format!("{card:<80}").bytes());
    }
    b.resize(b.len().div_ceil(2880) * 2880, b' ');
    b.extend(data);
    b.resize(b.len().div_ceil(2880) * 2880, 0);
    b
}

const CARDS: [&str; 10] = [
    "SIMPLE  =                    T / standard",
    "BITPIX  =                   16",
    "NAXIS   =                    2",
    "NAXIS1  =                    3",
    "NAXIS2  =                    2",
    "BSCALE  =                  0.5",
    "BZERO   =                 10.0",
    "BLANK   =                  -60",
    "BUNIT   = 'um      '           / height",
    "CDELT1  =                0.001",
];

fn fits_map() -> Vec<u8> {
    let data: Vec<u8> = raw().iter().flat_map(|v| (*v as i16).to_be_bytes()).collect();
    let more = ["CUNIT1  = 'm'", "CDELT2  =                  2.0", "CUNIT2  = 'mm'"];
    fits(&[&CARDS[..], &more].concat(), &data)
}

fn element(kind: u32, data: &[u8]) -> Vec<u8> {
    let mut b = kind.to_le_bytes().to_vec();
    b.extend((data.len() as u32).to_le_bytes());
    b.extend(data);
    b.resize(b.len().div_ceil(8) * 8, 0);
    b
}

fn matrix(name: &str, rows: i32, columns: i32, kind: u32, data: &[u8]) -> Vec<u8> {
    let sizes = [rows.to_le_bytes(), columns.to_le_bytes()].concat();
    let inside = [
        element(6, &[6, 0, 0, 0, 0, 0, 0, 0]),
        element(5, &sizes),
        element(1, name.as_bytes()),
        element(kind, data),
    ];
    element(14, &inside.concat())
}

fn mat(elements: &[Vec<u8>]) -> Vec<u8> {
    let mut b = b"MATLAB 5.0 MAT-file, made by a test".to_vec();
    b.resize(124, b' ');
    b.extend([0, 1, b'I', b'M']);
    b.extend(elements.concat());
    b
}

fn deflated(data: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(data.len() + 1000);
    let mut stream = Compress::new(Compression::best(), true);
    stream.compress_vec(data, &mut out, FlushCompress::Finish).unwrap();
    let mut b = 15_u32.to_le_bytes().to_vec();
    b.extend((out.len() as u32).to_le_bytes());
    b.extend(out);
    b
}

/// Returns a MATLAB file with the map Z, stored column by column, and X and Y as `meshgrid` makes them. X is
/// compressed.
fn mat_map() -> Vec<u8> {
    let columns = |m: &Array2<f64>| m.t().iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let z: Vec<u8> = raw().t().iter().map(|v| *v as i8 as u8).collect();
    let x = array![[0.0, 0.5, 1.0], [0.0, 0.5, 1.0]];
    let y = array![[2.0, 2.0, 2.0], [1.0, 1.0, 1.0]];
    mat(&[
        matrix("Z", 2, 3, 1, &z),
        deflated(&matrix("X", 2, 3, 9, &columns(&x))),
        matrix("Y", 2, 3, 9, &columns(&y)),
    ])
}

const ZYGO: &str = "Zygo XYZ Data File - Format 1\n0\n0\n0 0 3 2\n\"\"\n\"\"\n\"\"\n\
                    0 0.5 6.328e-007 0 1 0 1.5e-004 0\n0\n0\n0\n0\n0\n0\n#\n0 0 1\n1 0 -2\n2 0 3\n\
                    0 1 40\n1 1 50\n2 1 -60\n#\n";

const SDF: &str = "aISO-1.0\nManufacID = test\nNumPoints = 3\nNumProfiles = 2\nXscale = 1e-3\n\
                   Yscale = 2e-3\nZscale = 1e-6\nZresolution = -1\nCompression = 0\nDataType = 7\n\
                   CheckType = 0\n*\n1 -2 3\n40 50 BAD\n*\n";

fn sdf_binary() -> Vec<u8> {
    let mut b = b"bISO-1.0test      010120260000010120260000".to_vec();
    b.extend([3_u16.to_le_bytes(), 2_u16.to_le_bytes()].concat());
    b.extend([1e-3_f64, 2e-3, 1e-6, -1.0].iter().flat_map(|v| v.to_le_bytes()));
    b.extend([0, 5, 0]);
    b.extend(raw().iter().flat_map(|v| (*v as i16).to_le_bytes()));
    b
}

/// Returns one valid file of every format that can be written here, as the start of random damage.
fn seeds() -> Vec<(Format, Vec<u8>)> {
    let phase: Vec<i32> = raw().iter().map(|v| *v as i32).collect();
    let f64s: Vec<u8> = raw().iter().flat_map(|v| v.to_le_bytes()).collect();
    vec![
        (Format::Metropro, metropro(2, 3, &phase)),
        (Format::Npy, npy("<f8", "(2, 3)", false, &f64s)),
        (Format::Fits, fits_map()),
        (Format::Mat5, mat_map()),
        (Format::Xyz, ZYGO.into()),
        (Format::Xyz, "0 0 1\n1 0 -2\n2 0 3\n0 1 40\n1 1 50\n2 1 -60\n".into()),
        (Format::Csv, "# a\n1,-2,3\n40,50,-60\n".into()),
        (Format::Sdf, SDF.into()),
        (Format::Sdf, sdf_binary()),
        (Format::Hdf5, include_bytes!("data/map.h5").to_vec()),
        (Format::Datx, include_bytes!("data/map.datx").to_vec()),
        (Format::Gsf, include_bytes!("data/cases/map.gsf").to_vec()),
        (Format::Gwy, include_bytes!("data/cases/map.gwy").to_vec()),
        (Format::Sur, include_bytes!("data/cases/map.sur").to_vec()),
        (Format::CodevInt, include_bytes!("data/cases/map.int").to_vec()),
        (Format::GridSag, include_bytes!("data/cases/grid-sag.dat").to_vec()),
        (Format::X3p, include_bytes!("data/cases/map.x3p").to_vec()),
        (Format::Opd, include_bytes!("data/cases/map.opd").to_vec()),
        (Format::Presurface, include_bytes!("data/cases/presurface.dat").to_vec()),
        (Format::FourSight, include_bytes!("data/cases/4sight.h5").to_vec()),
    ]
}

fn message(format: Format, bytes: &[u8]) -> String {
    let made = read(format, bytes, &Pick::default())
        .and_then(|reading| surface(reading, &ReadingSettings::default()));
    made.expect_err("a refusal").to_string()
}

#[test]
fn metropro_factors_sign_and_invalid_pixels() {
    let mut b = metropro(2, 3, &[1, -2, 3, 40, 50, 2_147_483_640]);
    let settings = ReadingSettings::default();
    let made = |b: &[u8]| {
        assert_eq!(Format::recognise(b), Some(Format::Metropro));
        surface(read(Format::Metropro, b, &Pick::default()).unwrap(), &settings).unwrap()
    };
    let (map, statement) = made(&b);
    // W S O / R in m, in the order of the code; nm.
    let k = f64::from(6.328e-7_f32) * 0.5 * 1.0 / 32768.0 * 1e9;
    assert_eq!(statement.nm_per_value, k);
    // The first row is the top.
    assert_eq!(map.height_nm().row(1), array![k, -2.0 * k, 3.0 * k]);
    assert!(map.height_nm()[[0, 2]].is_nan() && statement.invalid == 1);
    assert_eq!(statement.pixel_mm[0], f64::from(1.5e-4_f32) * 1e3);

    b[232..234].copy_from_slice(&1_i16.to_be_bytes());
    let (map, statement) = made(&b);
    assert_eq!(map.height_nm()[[1, 0]], -k);
    assert!(statement.warnings[0].contains("sign word is 1"));

    b[218..220].copy_from_slice(&0_i16.to_be_bytes());
    // 4096 in the place of 32768.
    assert_eq!(made(&b).0.height_nm()[[1, 0]], -8.0 * k);
}

#[test]
fn npy_of_every_type_and_order() {
    let pick = Pick::default();
    let values = |b: &[u8]| read(Format::Npy, b, &pick).unwrap().values;
    let big: Vec<u8> = raw().iter().flat_map(|v| (*v as f32).to_be_bytes()).collect();
    assert_eq!(values(&npy(">f4", "(2, 3)", false, &big)), raw());
    let bytes: Vec<u8> = raw().iter().map(|v| *v as i8 as u8).collect();
    assert_eq!(values(&npy("|i1", "(2, 3)", false, &bytes)), raw());
    let fortran: Vec<u8> = raw().t().iter().flat_map(|v| (*v as i64).to_le_bytes()).collect();
    assert_eq!(values(&npy("<i8", "(2, 3)", true, &fortran)), raw());
}

#[test]
fn fits_scale_blank_unit_and_pitch() {
    let reading = read(Format::Fits, &fits_map(), &Pick::default()).unwrap();
    assert_eq!((reading.values.row(0), reading.offset, reading.factor), (raw().row(0), 10.0, 0.5));
    assert!(reading.values[[1, 2]].is_nan());
    assert_eq!(reading.unit, Some(Unit::named("um")));
    // Steps alone: 0 is at the first pixel.
    let (map, statement) = surface(reading, &ReadingSettings::default()).unwrap();
    // Halves of these numbers are exact, in um: nm.
    assert_eq!(map.height_nm().row(0), raw().row(0).mapv(|v| (10.0 + 0.5 * v) * 1e3));
    assert_eq!((statement.nm_of_zero, statement.nm_per_value), (1e4, 500.0));
    let grid = *map.grid();
    assert_eq!((grid.x.start_mm(), grid.x.step_mm()), (0.0, 1.0));
    assert_eq!((grid.y.start_mm(), grid.y.step_mm()), (0.0, 2.0));
}

/// Returns a FITS file of 2 rows and 3 columns, with heights 0 to 5 nm row by row, and these further cards.
fn placed(cards: &[&str]) -> Vec<u8> {
    let data: Vec<u8> = (0..6).flat_map(|v| f64::from(v).to_be_bytes()).collect();
    let first = ["SIMPLE  = T", "BITPIX  = -64", "NAXIS   = 2", "NAXIS1  = 3", "NAXIS2  = 2"];
    fits(&[&first[..], &["BUNIT   = 'nm'"], cards].concat(), &data)
}

/// Returns [x, y, z] of every pixel of a FITS file (mm, mm, nm), or the message.
fn heights(bytes: &[u8], settings: &ReadingSettings) -> Result<Vec<[f64; 3]>, String> {
    let reading = read(Format::Fits, bytes, &Pick::default()).map_err(|e| e.to_string())?;
    let (map, _) = surface(reading, settings).map_err(|e| e.to_string())?;
    let (g, z) = (map.grid(), map.height_nm());
    Ok(z.indexed_iter()
        .map(|((r, c), z)| [g.x.coordinate_mm(c), g.y.coordinate_mm(r), *z])
        .collect())
}

#[test]
fn fits_pixels_lie_where_the_header_says() {
    let linear = [
        "CRPIX1  = 2.0",
        "CRVAL1  = 10.0",
        "CDELT1  = 0.5",
        "CUNIT1  = 'mm'",
        "CRPIX2  = 2.5",
        "CRVAL2  = -4.0D3",
        "CDELT2  = -250",
        "CUNIT2  = 'um'",
    ];
    let without = |key: &str| -> Vec<&str> {
        linear.into_iter().filter(|card| !card.starts_with(key)).collect()
    };
    let plain = ReadingSettings::default();
    // Every height with its coordinate by the formula of the standard, pixels counted from 1; these steps and places
    // are exact in binary, but for um.
    let expected = |x: &dyn Fn(f64) -> f64, y: &dyn Fn(f64) -> f64| -> Vec<[f64; 3]> {
        let at = |k: usize| [x((k % 3 + 1) as f64), y((k / 3 + 1) as f64), k as f64];
        (0..6).map(at).collect()
    };
    let same = |found: Vec<[f64; 3]>, expected: &[[f64; 3]]| {
        assert_eq!(found.len(), expected.len());
        for f in found {
            let near = |e: &&[f64; 3]| (f[0] - e[0]).hypot(f[1] - e[1]) < 1e-12;
            assert_eq!(expected.iter().find(near).map(|e| e[2]), Some(f[2]), "{f:?} {expected:?}");
        }
    };
    let (x, y) = (|i: f64| 10.0 + 0.5 * (i - 2.0), |j: f64| -4.0 - 0.25 * (j - 2.5));
    same(heights(&placed(&linear), &plain).unwrap(), &expected(&x, &y));
    // The same step as a matrix, or as a factor of one.
    let matrix = [&without("CDELT")[..], &["CD1_1   = 0.5", "CD2_2   = -250.", "CD1_2   = 1E-9"]];
    same(heights(&placed(&matrix.concat()), &plain).unwrap(), &expected(&x, &y));
    let factor = [&without("CDELT1")[..], &["CDELT1  = 0.25", "PC1_1   = 2.0"]].concat();
    same(heights(&placed(&factor), &plain).unwrap(), &expected(&x, &y));
    // A place that is not in the header is 0, a pixel too.
    let part = [&without("CRPIX")[..], &[]].concat();
    same(
        heights(&placed(&part), &plain).unwrap(),
        &expected(&|i| 10.0 + 0.5 * i, &|j| -4.0 - 0.25 * j),
    );
    // Another pitch leaves the reference where it is.
    let pitch =
        ReadingSettings { pixel_mm: Some([0.25, 0.5]), override_file: true, ..plain.clone() };
    same(
        heights(&placed(&linear), &pitch).unwrap(),
        &expected(&|i| 10.0 + 0.25 * (i - 2.0), &|j| -4.0 - 0.5 * (j - 2.5)),
    );
    // The part is turned about 0: (x, y) -> (-y, x), mirrored before.
    let turned = ReadingSettings { flip_x: true, rotation: Rotation::Quarter, ..plain.clone() };
    let there: Vec<[f64; 3]> = expected(&x, &y).into_iter().map(|[x, y, z]| [-y, -x, z]).collect();
    same(heights(&placed(&linear), &turned).unwrap(), &there);

    // Without their units they are asked for, and nothing is taken from the header without them.
    let bare: Vec<&str> = without("CUNIT");
    let said = heights(&placed(&bare), &plain).unwrap_err();
    assert!(said.contains("give `coordinate_unit`, or `pixel_mm`"), "{said}");
    let um = ReadingSettings { coordinate_unit: Some(Unit::named("um")), ..plain.clone() };
    same(
        heights(&placed(&bare), &um).unwrap(),
        &expected(&|i| 0.01 + 5e-4 * (i - 2.0), &|j| -4.0 - 0.25 * (j - 2.5)),
    );
    let reading = read(Format::Fits, &placed(&bare), &Pick::default()).unwrap();
    let (map, statement) = surface(reading, &pitch).unwrap();
    assert_eq!((map.grid().x.start_mm(), map.height_nm()[[0, 0]]), (0.0, 0.0));
    assert!(statement.warnings.iter().any(|w| w.contains("without their unit")), "{statement:?}");
    // Places without steps are named.
    let steps: Vec<&str> = without("CDELT");
    let reading = read(Format::Fits, &placed(&steps), &Pick::default()).unwrap();
    assert!(reading.warnings[0].starts_with("CRPIX1, CRPIX2, CRVAL1, CRVAL2 not used"));
}

#[test]
fn fits_axes_that_are_no_coordinates_of_a_map_are_refused() {
    let linear =
        ["CRVAL1  = 10.0", "CDELT1  = 0.5", "CUNIT1  = 'mm'", "CDELT2  = 0.5", "CUNIT2  = 'mm'"];
    let said = |card: &str, settings: &ReadingSettings| {
        heights(&placed(&[&linear[..], &[card]].concat()), settings).unwrap_err()
    };
    let plain = ReadingSettings::default();
    // 3 pixels at a slope of 1e-4 lie 3e-4 steps beside the axis, three times what is allowed.
    for card in ["PC1_2   = 0.3", "PC2_1   = -1E-4", "CD2_1   = 1.0", "CROTA2  = 5.0"] {
        assert!(said(card, &plain).contains("lies at an angle"), "{card}");
    }
    assert!(said("CTYPE1  = 'X----LOG'", &plain).contains("not linear"));
    let top = ReadingSettings { first_row: Some(FirstRow::Top), ..plain.clone() };
    assert!(said("CTYPE1  = 'X'", &top).contains("says where its rows lie"));
    let um = ReadingSettings { coordinate_unit: Some(Unit::named("um")), ..plain.clone() };
    assert!(said("CTYPE1  = 'X'", &um).contains("mm in the file, um was asked for"));
    let zero = placed(&["CDELT1  = 0.0", "CDELT2  = 1.0"]);
    assert!(heights(&zero, &plain).unwrap_err().contains("CDELT1 = 0"));
}

#[test]
fn mat_by_its_customary_names() {
    let reading = read(Format::Mat5, &mat_map(), &Pick::default()).unwrap();
    assert_eq!(reading.values, raw());
    let c = reading.coordinates.unwrap();
    assert_eq!((c.x, c.y), (vec![0.0, 0.5, 1.0], vec![2.0, 1.0]));
    let tif = Pick { is_tif: true, ..Pick::default() };
    let said = read(Format::Mat5, &mat_map(), &tif).unwrap_err().to_string();
    assert!(said.contains("several matrices: Z, X, Y") && said.contains("`dataset`"), "{said}");
}

#[test]
fn sdf_in_text_and_bytes() {
    for b in [SDF.as_bytes().to_vec(), sdf_binary()] {
        let reading = read(Format::Sdf, &b, &Pick::default()).unwrap();
        assert_eq!(reading.values.row(0), raw().row(0));
        assert_eq!((reading.unit, reading.factor), (Some(Unit::named("m")), 1e-6));
        assert_eq!(reading.pixel_mm, Some([1.0, 2.0]));
    }
}

#[test]
fn hdf5_and_datx_of_a_real_library() {
    // Written by h5py 3.16: docs/instruments.py, recipe `just test-interop`.
    for (format, bytes) in seeds().iter().filter(|s| matches!(s.0, Format::Hdf5 | Format::Datx)) {
        assert_eq!(Format::recognise(bytes), Some(*format));
        let reading = read(*format, bytes, &Pick::default()).unwrap();
        assert_eq!(reading.values.row(0), raw().row(0), "{format:?}");
        match format {
            Format::Datx => {
                assert!(reading.values[[1, 2]].is_nan());
                assert_eq!(reading.factor, 0.5 * 1.0 * 632.8e-9);
                assert_eq!(reading.pixel_mm, Some([0.25, 0.25]));
            }
            _ => assert_eq!(reading.unit, Some(Unit::named("nm"))),
        }
    }
}

#[test]
fn bad_files_are_refused_with_what_is_wrong() {
    let phase: Vec<i32> = raw().iter().map(|v| *v as i32).collect();
    let good = metropro(2, 3, &phase);
    let cut = &good[..good.len() - 1];
    assert!(message(Format::Metropro, cut).contains("is truncated"));
    let changed = |at: usize, bytes: &[u8]| {
        let mut b = good.clone();
        b[at..at + bytes.len()].copy_from_slice(bytes);
        message(Format::Metropro, &b)
    };
    assert!(changed(0, &[0]).contains("magic 001B036F"));
    assert!(changed(218, &[0, 3]).contains("resolution word 3"));
    assert!(changed(168, &[0, 0, 0, 0]).contains("wavelength in m 0"));
    assert!(changed(60, &u32::MAX.to_be_bytes()).contains("truncated"));
    // 65535 x 65535 pixels of 4 bytes: 16 GiB, the size does not fit the field either.
    assert!(changed(68, &[0xff; 8]).contains("65535 rows x 65535 columns"));
    let empty = metropro(0, 0, &[]);
    assert!(message(Format::Metropro, &empty).contains("no phase"));

    let f64s: Vec<u8> = raw().iter().flat_map(|v| v.to_le_bytes()).collect();
    let huge = npy("<f8", "(23170, 23170)", false, &f64s);
    assert!(message(Format::Npy, &huge).contains("at most"));
    let four = npy("<f8", "(5000, 5000)", false, &f64s);
    assert!(message(Format::Npy, &four).contains("truncated"));
    for (descriptor, shape, expected) in [
        ("<c16", "(2, 3)", "type \"<c16\""),
        ("<f8", "(6,)", "not two axes"),
        ("<f8", "(2, 2)", "16 bytes after"),
        ("<f8", "(1, 6)", "at least 2 x 2"),
    ] {
        let said = message(Format::Npy, &npy(descriptor, shape, false, &f64s));
        assert!(said.contains(expected), "{said}");
    }

    assert!(message(Format::Csv, b"1,2\n3,x\n").contains("\"x\" in line 2, field 2"));
    assert!(message(Format::Csv, b"1,2\n3\n").contains("1 fields in line 2, 2 before"));
    assert!(message(Format::Csv, b"\x00\x01").contains("not text"));
    assert!(message(Format::Xyz, ZYGO.replace("3 2", "70000 70000").as_bytes()).contains("70000"));
    assert!(message(Format::Xyz, ZYGO.replace("50", "fifty").as_bytes()).contains("\"fifty\""));

    let card = |at: usize, card: &'static str| {
        let mut cards = CARDS.to_vec();
        cards[at] = card;
        message(Format::Fits, &fits(&cards, &[0; 12]))
    };
    assert!(card(3, "NAXIS1  =              2000000").contains("truncated"));
    assert!(card(3, "NAXIS1  =           2000000000").contains("at most"));
    assert!(card(1, "BITPIX  =                   17").contains("BITPIX Some(17.0)"));
    assert!(card(4, "NAXIS2  =                 many").contains("\"many\" in card NAXIS2"));
    assert!(card(8, "BUNIT   = 'furlong '").contains("BUNIT: is \"furlong\""));
    assert!(message(Format::Fits, &fits_map()[..2881]).contains("truncated"));

    let claims = mat(&[matrix("Z", 1 << 15, 1 << 16, 9, &[0; 48])]);
    assert!(message(Format::Mat5, &claims).contains("32768 x 65536 in 48 bytes"));
    let text = mat(&[matrix("Z", 2, 3, 99, &[0; 48])]);
    assert!(message(Format::Mat5, &text).contains("stored as type 99"));
    let mut cut = mat_map();
    cut.truncate(300);
    assert!(message(Format::Mat5, &cut).contains("truncated"));
    assert!(message(Format::Sdf, SDF.replace("50", "").as_bytes()).contains("5 of 6"));
    assert!(message(Format::Hdf5, b"not this").contains("signature"));
}

/// Returns a damaged copy of a file: some bytes are replaced, or a part is removed, repeated or cut off at the end.
fn damaged(seed: &[u8], random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..random.random_range(1..5) {
        if bytes.is_empty() {
            return bytes;
        }
        let at = random.random_range(0..bytes.len());
        match random.random_range(0..6) {
            0 => bytes[at] = random.random_range(0..=255),
            1 => bytes[at] ^= 1 << random.random_range(0..8),
            2 => {
                let extreme = [0_u8, 0xff, 0x7f, 0x80][random.random_range(0..4)];
                let end = (at + random.random_range(1..9)).min(bytes.len());
                bytes[at..end].fill(extreme);
            }
            3 => bytes.truncate(at),
            4 => {
                let end = (at + random.random_range(1..40)).min(bytes.len());
                bytes.drain(at..end);
            }
            _ => {
                let end = (at + random.random_range(1..40)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                let to = random.random_range(0..=bytes.len());
                bytes.splice(to..to, piece);
            }
        }
    }
    bytes
}

fn executions() -> usize {
    let given = std::env::var("PLANISH_FUZZ_EXECUTIONS").ok();
    given.map_or(1000, |n| n.parse().expect("PLANISH_FUZZ_EXECUTIONS is a number"))
}

/// Checks that no damage makes a reader panic, and that all it still reads is a valid map.
#[test]
fn damaged_files_are_read_or_refused() {
    let settings = ReadingSettings {
        override_file: true,
        unit: Some(Unit::named("nm")),
        coordinate_unit: Some(Unit::named("mm")),
        pixel_mm: Some([1.0; 2]),
        ..ReadingSettings::default()
    };
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for (format, seed) in seeds() {
        let (mut accepted, mut refused) = (0, 0);
        for _ in 0..executions() {
            let bytes = damaged(&seed, &mut random);
            let outcome = panic::catch_unwind(|| {
                let _ = Format::recognise(&bytes);
                read(format, &bytes, &Pick::default()).map(|r| surface(r, &settings))
            });
            match outcome {
                Ok(Ok(_)) => accepted += 1,
                Ok(Err(error)) => {
                    refused += 1;
                    assert!(error.to_string().len() < 1500, "{error}");
                }
                Err(_) => panic!("{format:?} panics on {bytes:?}"),
            }
        }
        println!("{format:?}: {accepted} read, {refused} refused");
        assert!(refused > 0, "{format:?}");
    }
}

#[test]
fn damaged_programs_are_read_or_refused() {
    let configuration = Configuration {
        start_mm: Some([0.0; 2]),
        count_mm: Some([1e-3; 2]),
        sample_s: Some(1e-3),
        feedrate_time_unit_s: Some(1.0),
        ..Configuration::default()
    };
    let seeds = [
        (
            ControllerKind::Galil,
            "' x\nPVA=0,0,-1\nPVA=100,5,100\nPVB=0,0,100\nBTAB\nPVA=0,0,0\nPVB=0,0,0\n",
        ),
        (ControllerKind::Xps, "0.1, 1, 0.5, 0, 0\n0.2, 0, 0, 0, 0\n"),
        (
            ControllerKind::Pmac,
            "M7=0\nABS\nM7==1\nPVT100\nX2:0 Y-2:0\nINC\nPVT(200)\nX2 Y-2:0\nM7==0\nDWELL0\n",
        ),
        (
            ControllerKind::Gcode,
            "(x) G21 G90\nG0 X1 Y-2\nG93\nM62 P0\nG1 X2 F600 ; y\nG4 P0.2\nM65 P0\nM2\n",
        ),
        (
            ControllerKind::Csv,
            "t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on\n0,1,0,-2,0,1\n0.1,2,0,-2,0,1\n",
        ),
        (
            ControllerKind::Aerotech,
            "' x\nPROGRAM\nABS\nLINEAR X 1 Y -2\nVELOCITY ON\nPVT INIT TIME ABS\nPVT X 2,0 Y -2,0 TIME 0.1\n\
             WAIT MOVEDONE X Y\nVELOCITY OFF\nEND PROGRAM\n",
        ),
        (
            ControllerKind::Automation1,
            "// x\nprogram\nSetupTaskTargetMode(TargetMode.Absolute)\nSetupTaskTimeUnits(TimeUnits.Seconds)\n\
             MovePvt([X, Y], [2, -2], [0, 0], 100)\nWaitForMotionDone([X, Y])\nend\n",
        ),
        (
            ControllerKind::Sinumerik,
            "; x\nN1 G17 G90\nFGROUP(X,Y)\nG642 CTOL=0.005\nG0 X1 Y-2\nG93\nG1 X2 F600\nG4 F0.2\nM30\n",
        ),
        (
            ControllerKind::SinumerikPoly,
            "; x\nG0 X1 Y=-2 W=0\nFGROUP(W)\nUPATH\nF60\nPOLY PO[X]=(2,0.0003,-0.000002) PO[Y]=(-2) W=0.1 PL=100\nM30\n",
        ),
        (
            ControllerKind::Twincat,
            "# x\ncycle_s,0.1\ncycle,x_mm,vx_mm_per_s,ax_mm_per_s2,y_mm,vy_mm_per_s,ay_mm_per_s2,tool_on,segment\n\
             0,1,0,600,-2,0,0,1,0\n1,2,0,0,-2,0,0,0,1\n",
        ),
        (ControllerKind::XpsPt, "0.1, 1, 0.5\n0.2, 0, 0\n"),
        (
            ControllerKind::Zaber,
            "Time (s),x Position (mm),x Velocity (mm/s),y Position (mm),y Velocity (mm/s)\n0.1,2,0,-2,0\n",
        ),
        (
            ControllerKind::Ros,
            "{\"header\": {\"stamp\": {\"sec\": 0, \"nanosec\": 0}, \"frame_id\": \"\"}, \
             \"joint_names\": [\"x\", \"y\"], \"points\": [{\"positions\": [0.001, -0.002], \
             \"velocities\": [0.0, 0.0], \"time_from_start\": {\"sec\": 0, \"nanosec\": 0}}, {\"positions\": [0.002, -0.002], \"velocities\": [0.0, 0.0], \
             \"time_from_start\": {\"sec\": 0, \"nanosec\": 100000000}}]}\n",
        ),
    ];
    let mut random = ChaCha8Rng::seed_from_u64(2);
    for (controller, seed) in seeds {
        program::read(controller, seed.as_bytes(), &configuration).unwrap();
        let mut refused = 0;
        for _ in 0..executions() {
            let bytes = damaged(seed.as_bytes(), &mut random);
            let outcome = panic::catch_unwind(|| program::read(controller, &bytes, &configuration));
            match outcome {
                Ok(read) => refused += usize::from(read.is_err()),
                Err(_) => panic!("{controller:?} panics on {:?}", String::from_utf8_lossy(&bytes)),
            }
        }
        assert!(refused > 0, "{controller:?}");
    }
}
