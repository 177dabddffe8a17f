//! Libraries of plugins, whose digests are in every product, do not depend on where they were built.
//! `cargo xtask second-checkout` builds all of them twice.

use dragfree_tests::{built, expect, root};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Folder of the crates that are not ours.
fn cargo_home() -> PathBuf {
    let home = || std::env::home_dir().expect("a home").join(".cargo");
    std::env::var_os("CARGO_HOME").map_or_else(home, PathBuf::from)
}

fn holds(bytes: &[u8], text: &str) -> bool {
    bytes.windows(text.len()).any(|window| window == text.as_bytes())
}

fn name_of(library: &str) -> String {
    format!("{}{library}{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX)
}

#[test]
fn no_library_says_where_it_was_built() {
    let names = ["effects", "es_akf", "gracefo", "hinf_dfacs", "preprocess", "qp_check", "sim"];
    for library in names.map(|name| built().join(name_of(&format!("dragfree_{name}")))) {
        let bytes = std::fs::read(&library).expect("a library");
        // Where a panic is, stands in the text of it: in our crates below the workspace, in others below the crate.
        assert!(holds(&bytes, "/src/lib.rs") && holds(&bytes, "nalgebra-0."), "{}", library.display());
        for folder in [root(), &cargo_home(), Path::new("registry/src"), built()] {
            let folder = folder.to_str().expect("text");
            assert!(!holds(&bytes, folder), "{} has {folder} in it", library.display());
        }
    }
}

/// A workspace with a library that uses a crate of others, which says where it panics.
fn workspace(folder: &Path) {
    let member = folder.join("member/src");
    std::fs::create_dir_all(&member).expect("folders");
    std::fs::create_dir(folder.join(".cargo")).expect("a folder");
    for file in ["config.toml", "rustc.sh"] {
        std::fs::copy(root().join(".cargo").join(file), folder.join(".cargo").join(file)).expect("copied");
    }
    std::fs::copy(root().join("Cargo.lock"), folder.join("Cargo.lock")).expect("copied");
    let write = |name: &str, text: &str| std::fs::write(folder.join(name), text).expect("written");
    write("Cargo.toml", "[workspace]\nresolver = \"3\"\nmembers = [\"member\"]\n");
    write(
        "member/Cargo.toml",
        "[package]\nname = \"member\"\nedition = \"2024\"\n[lib]\ncrate-type = [\"cdylib\"]\n\
         [dependencies]\nstrength_reduce = \"0.2\"\n",
    );
    write(
        "member/src/lib.rs",
        "#[unsafe(no_mangle)]\npub extern \"C\" fn quotient(x: u64, divisor: u64) -> u64 {\n    \
         x / strength_reduce::StrengthReducedU64::new(divisor)\n}\n",
    );
}

/// Builds it with crates at `crates`; gives the library.
fn build(folder: &Path, crates: &Path, as_configured: bool) -> Vec<u8> {
    std::fs::create_dir_all(crates).expect("a folder");
    for entry in std::fs::read_dir(cargo_home()).expect("crates").flatten() {
        let _ = std::os::unix::fs::symlink(entry.path(), crates.join(entry.file_name())); // there the second time
    }
    let target = folder.join(if as_configured { "target" } else { "target-plain" });
    let mut build = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    build.current_dir(folder).env("CARGO_HOME", crates).env("CARGO_TARGET_DIR", &target);
    build.env_remove("RUSTC_WRAPPER").args(["build", "--quiet", "--release", "--offline"]);
    if !as_configured {
        build.env("RUSTC_WRAPPER", "");
    }
    expect(&mut build, 0);
    std::fs::read(target.join("release").join(name_of("member"))).expect("a library")
}

/// Two checkouts of two users: one library. Without `.cargo/rustc.sh` there are two.
#[test]
fn a_library_is_the_same_wherever_checkout_and_crates_lie() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let both = |as_configured: bool| {
        ["a", "somebody else"].map(|name| {
            let user = dir.path().join(name);
            if !user.exists() {
                workspace(&user.join("checkout"));
            }
            build(&user.join("checkout"), &user.join("home/.cargo"), as_configured)
        })
    };
    let [one, other] = both(true);
    assert!(one == other, "the libraries differ");
    assert!(holds(&one, "strength_reduce-0.2"), "it says where it panics, or this shows nothing");
    let [one, other] = both(false);
    assert!(one != other, "crates at another place change nothing: this test shows nothing");
}
