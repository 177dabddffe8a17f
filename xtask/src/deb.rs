//! A Debian package: an `ar` archive of a format number, a tar with what the package says of itself, and a tar of the
//! files.

use crate::Failure;
use crate::tree::Tree;
use flate2::{Compression, write::GzEncoder};

/// Bytes of the package that installs `tree` below `/usr`.
pub(crate) fn package(tree: &Tree, version: &str, time_s: u64) -> Result<Vec<u8>, Failure> {
    let packed = |tree: &Tree, top: &str| -> Result<Vec<u8>, Failure> {
        Ok(tree.tar(top, time_s, GzEncoder::new(Vec::new(), Compression::default()))?.finish()?)
    };
    let mut control = Tree::default();
    control.put("control", about(tree, version));
    let mut ar = b"!<arch>\n".to_vec();
    member(&mut ar, "debian-binary", time_s, b"2.0\n");
    member(&mut ar, "control.tar.gz", time_s, &packed(&control, ".")?);
    member(&mut ar, "data.tar.gz", time_s, &packed(tree, "./usr")?);
    Ok(ar)
}

fn about(tree: &Tree, version: &str) -> String {
    let architecture = match std::env::consts::ARCH {
        "x86_64" => "amd64",
        "aarch64" => "arm64",
        other => other,
    };
    format!(
        "Package: dragfree\nVersion: {version}\nArchitecture: {architecture}\nMaintainer: The dragfree developers\n\
         Installed-Size: {}\nDepends: libc6 (>= 2.{}), libgcc-s1\nSection: science\nPriority: optional\n\
         Description: calibration of the centre-of-mass offset of drag-free spacecraft\n \
         Replays telemetry through a chain of plugins and archives a versioned calibration\n \
         of the offset between the centre of mass and each test mass.\n",
        tree.size().div_ceil(1024),
        libc_minor(tree)
    )
}

/// The highest x of `GLIBC_2.x` that a program or a library asks for.
fn libc_minor(tree: &Tree) -> u32 {
    const VERSION: &[u8] = b"GLIBC_2.";
    let of = |bytes: &[u8]| {
        let found = bytes.windows(VERSION.len()).enumerate().filter(|(_, window)| *window == VERSION);
        let number = |at: usize| {
            let digits: Vec<u8> = bytes[at..].iter().copied().take_while(u8::is_ascii_digit).take(3).collect();
            String::from_utf8(digits).ok()?.parse().ok()
        };
        found.filter_map(|(at, _)| number(at + VERSION.len())).max().unwrap_or(0)
    };
    ["bin/", "lib/"].into_iter().flat_map(|folder| tree.below(folder)).map(of).max().unwrap_or(0)
}

/// A header of 60 bytes and the contents, filled up to an even length.
fn member(ar: &mut Vec<u8>, name: &str, time_s: u64, bytes: &[u8]) {
    ar.extend(format!("{name:<16}{time_s:<12}{:<6}{:<6}{:<8}{:<10}`\n", 0, 0, "100644", bytes.len()).bytes());
    ar.extend(bytes);
    if !bytes.len().is_multiple_of(2) {
        ar.push(b'\n');
    }
}
