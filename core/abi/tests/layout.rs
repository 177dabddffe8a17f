//! A C program compiled here prints the layout that the C compiler gives to every struct of `plugin.h`; it must be
//! the layout that rustc gives to the mirror.

use dragfree_abi as abi;
use std::collections::BTreeMap;
use std::mem::{offset_of, size_of};
use std::path::Path;
use std::process::Command;

macro_rules! layout {
    ($map:ident, $rust:ty, $c:literal, { $($field:ident : $c_field:literal),* $(,)? }) => {
        $map.insert(concat!("sizeof ", $c).to_owned(), size_of::<$rust>());
        $( $map.insert(concat!($c, ".", $c_field).to_owned(), offset_of!($rust, $field)); )*
    };
}

fn rust_layout() -> BTreeMap<String, usize> {
    let mut m = BTreeMap::new();
    layout!(m, abi::ArrowSchema, "struct ArrowSchema", { format: "format", name: "name", metadata: "metadata", flags: "flags",
        n_children: "n_children", children: "children", dictionary: "dictionary", release: "release", private_data: "private_data" });
    layout!(m, abi::ArrowArray, "struct ArrowArray", { length: "length", null_count: "null_count", offset: "offset", n_buffers: "n_buffers",
        n_children: "n_children", buffers: "buffers", children: "children", dictionary: "dictionary", release: "release", private_data: "private_data" });
    layout!(m, abi::ErrorV1, "dragfree_error_v1", { text: "text", capacity: "capacity" });
    layout!(m, abi::WriterV1, "dragfree_writer_v1", { context: "context", write: "write" });
    layout!(m, abi::HostV1, "dragfree_host_v1", { context: "context", log: "log" });
    layout!(m, abi::ConfigV1, "dragfree_config_v1", { context: "context", json: "json", get_f64: "get_f64", get_text: "get_text" });
    layout!(m, abi::ColumnV1, "dragfree_column_v1", { table: "table", name: "name", unit: "unit", frame: "frame", rate_hz: "rate_hz", attributes: "attributes" });
    layout!(m, abi::SlotV1, "dragfree_slot_v1", { table: "table", column: "column" });
    layout!(m, abi::LinkV1, "dragfree_link_v1", { context: "context", available_count: "available_count", available: "available",
        model_json: "model_json", read: "read", write: "write", coefficient: "coefficient", constraint: "constraint" });
    layout!(m, abi::InputsV1, "dragfree_inputs_v1", { complete_until_ns: "complete_until_ns", table_count: "table_count", schemas: "schemas", tables: "tables" });
    layout!(m, abi::ProgressV1, "dragfree_progress_v1", { complete_until_ns: "complete_until_ns", done: "done" });
    layout!(m, abi::NodeV1, "dragfree_node_v1", { self_: "self", link: "link", activate: "activate", process: "process", next: "next",
        flush: "flush", report: "report", save: "save", load: "load", destroy: "destroy" });
    layout!(m, abi::FactoryV1, "dragfree_factory_v1", { count: "count", manifest: "manifest", create: "create" });
    layout!(m, abi::EntryV1, "dragfree_entry_v1", { abi_version: "abi_version", reserved: "reserved", get_factory: "get_factory" });
    m
}

fn run(command: &mut Command) -> String {
    let out = command.output().unwrap_or_else(|e| panic!("{command:?}: {e}; the tests need a C compiler"));
    assert!(out.status.success(), "{command:?}:\n{}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).expect("the program prints ASCII")
}

#[test]
fn the_mirror_has_the_layout_of_the_header() {
    let rust = rust_layout();
    let mut source = String::from("#include <stdio.h>\n#include <dragfree/plugin.h>\nint main(void) {\n");
    for key in rust.keys() {
        let expression = match key.strip_prefix("sizeof ") {
            Some(ty) => format!("sizeof({ty})"),
            None => {
                let (ty, field) = key.rsplit_once('.').expect("a field has a dot");
                format!("offsetof({ty}, {field})")
            }
        };
        source += &format!("  printf(\"{key}=%zu\\n\", (size_t){expression});\n");
    }
    source += &format!(
        "  printf(\"version=%u\\n\", DRAGFREE_ABI_VERSION);\n  return !(DRAGFREE_OK=={} && DRAGFREE_DISCARD=={} && DRAGFREE_ERROR=={} && DRAGFREE_FATAL=={});\n}}\n",
        abi::OK,
        abi::DISCARD,
        abi::ERROR,
        abi::FATAL
    );
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (c, exe) = (dir.path().join("layout.c"), dir.path().join("layout"));
    std::fs::write(&c, source).expect("the folder is writable");
    let include = Path::new(env!("CARGO_MANIFEST_DIR")).join("include");
    let compiler = std::env::var("CC").unwrap_or_else(|_| "cc".to_owned());
    run(Command::new(compiler)
        .args(["-std=c11", "-Wall", "-Werror", "-pedantic", "-I"])
        .arg(include)
        .arg("-o")
        .arg(&exe)
        .arg(&c));
    let printed = run(&mut Command::new(exe));
    let mut from_c: BTreeMap<_, usize> = printed
        .lines()
        .map(|l| l.split_once('=').expect("key=value"))
        .map(|(k, v)| (k.to_owned(), v.parse().expect("a number")))
        .collect();
    assert_eq!(from_c.remove("version"), Some(abi::ABI_VERSION as usize));
    assert_eq!(from_c, rust);
}
