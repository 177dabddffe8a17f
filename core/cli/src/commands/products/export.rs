//! `dragfree products export`.

use super::parquet;
use crate::args::Format;
use crate::commands::Done;
use crate::failure::Failure;
use chrono::{DateTime, SecondsFormat};
use dragfree_archive::files::IoContext as _;
use dragfree_archive::product::{self, Coefficient, Product};
use dragfree_archive::{Archive, JOINT};
use dragfree_workflow::{foxglove, joint::rate_of};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

pub(super) fn execute(name: &str, format: Format, out: Option<&Path>, folder: &Path) -> Result<Done, Failure> {
    let written = super::open(name, folder)?;
    let content = match format {
        Format::Csv => csv(&written.product).into_bytes(),
        Format::Vcm1b => vcm1b(&written.product)?.into_bytes(),
        Format::Json => format!("{:#}\n", product::to_json(&written.product, &written.path)).into_bytes(),
        Format::Parquet => parquet::coefficients(&written.product)?,
        Format::Foxglove => {
            format!("{:#}\n", foxglove::layout(&Archive::open(folder)?, written.product.id())?).into_bytes()
        }
    };
    let Some(path) = out else {
        let text = String::from_utf8(content).ok().filter(|_| format != Format::Parquet);
        return text.map(Done::new).ok_or_else(|| "a Parquet file is no text; name one with --out FILE".into());
    };
    std::fs::write(path, content).at("write", path)?;
    Ok(Done::new(format!("{}\n", path.display())))
}

/// A row per coefficient of every solution; a missing number is an empty field.
fn csv(product: &Product) -> String {
    let mut text = "product,day,spacecraft,solution,coefficient,value,sigma,unit,frame\n".to_owned();
    let day = &product.header.non_standard_attributes.day;
    let spacecraft = &product.header.global_attributes.platform;
    let number = |x: f64| if x.is_finite() { format!("{x:e}") } else { String::new() };
    for c in &product.result.coefficients {
        let (id, value, sigma) = (product.id(), number(c.value), number(c.sigma));
        let _ = writeln!(
            text,
            "{id},{day},{spacecraft},{},{},{value},{sigma},{},{}",
            field(&c.solution),
            field(&c.name),
            field(&c.unit),
            field(&c.frame)
        );
    }
    text
}

/// A field as RFC 4180 has it.
fn field(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}

/// GPS time's epoch of GRACE-FO products, 2000-01-01T12:00:00, Unix ns of the same scale.
const EPOCH_NS: i64 = 946_728_000_000_000_000;
/// GPS minus UTC since 2017-01-01, s. Later leap seconds are not known to the program; the header says what was used.
const GPS_MINUS_UTC_S: i64 = 18;
/// GPS minus TAI, s.
const GPS_MINUS_TAI_S: i64 = -19;

/// The offset of every test mass in the text format of GRACE-FO's VCM1B: length and direction cosines of a vector, here
/// from the centre of mass to the housing, as the offset is defined.
fn vcm1b(product: &Product) -> Result<String, Failure> {
    let offsets = offsets(product);
    if offsets.is_empty() {
        return Err(format!(
            "{} has no offset in three axes of any test mass, which VCM1B needs; --format csv writes what it has",
            product.id()
        )
        .into());
    }
    let global = &product.header.global_attributes;
    let attributes = &product.header.non_standard_attributes;
    let shift_s = match attributes.time_scale.as_str() {
        "GPS" => 0,
        "TAI" => GPS_MINUS_TAI_S,
        _ => GPS_MINUS_UTC_S,
    };
    let epoch_s = |ns: i64| (ns - EPOCH_NS).div_euclid(1_000_000_000) + shift_s;
    let quoted = |text: &str| serde_json::Value::from(text).to_string();
    let stop = DateTime::from_timestamp_nanos(product.result.epoch_ns).to_rfc3339_opts(SecondsFormat::Millis, true);
    let mut text = String::new();
    let _ = write!(
        text,
        "header:\n  dimensions:\n    num_records: {records}\n  global_attributes:\n    conventions: {conventions}\n    \
         date_created: {created}\n    id: {id}\n    platform: {platform}\n    processing_level: {level}\n    \
         product_version: {version}\n    project: {project}\n    source: {source}\n    \
         summary: Vector from the spacecraft's centre of mass to the centre of each test mass's housing\n    \
         time_coverage_start: {start}\n    time_coverage_stop: {end}\n    title: {title}\n  \
         non-standard_attributes:\n    epoch_time: 2000-01-01T12:00:00.00\n    epoch_of_values: {stop}\n    \
         gps_minus_time_scale_seconds: {shift_s}\n    time_scale_of_product: {scale}\n    software_version: {software}\n    \
         sha256: {sha256}\n",
        records = offsets.len(),
        conventions = quoted(&global.conventions),
        created = global.date_created,
        id = product.id(),
        platform = quoted(&global.platform),
        level = global.processing_level,
        version = quoted(&global.product_version),
        project = quoted(&global.project),
        source = quoted(&global.source),
        start = global.time_coverage_start,
        end = global.time_coverage_stop,
        title = quoted(&global.title),
        scale = attributes.time_scale,
        software = quoted(&attributes.software_version),
        sha256 = attributes.sha256,
    );
    for (test_mass, offset) in &offsets {
        let sigma: Vec<String> = offset.sigma_m.iter().map(|s| format!("{s:e}")).collect();
        let _ = writeln!(text, "    sigma_{test_mass}_m: [{}]", sigma.join(", "));
        let _ = writeln!(text, "    frame_{test_mass}: {}", quoted(&offset.frame));
        if let Some(rate) = &offset.rate {
            let list = |of: fn(&Coefficient) -> f64| rate.map(|c| format!("{:e}", of(c))).join(", ");
            let _ = writeln!(text, "    rate_{test_mass}_m_s: [{}]", list(|c| c.value));
            let _ = writeln!(text, "    sigma_rate_{test_mass}_m_s: [{}]", list(|c| c.sigma));
        }
    }
    if attributes.product == JOINT {
        let _ = writeln!(text, "    comment: {}", quoted(OF_MANY_DAYS));
    }
    text += "  variables:\n";
    let columns = [
        ("gps_time", "1st", "Seconds past 12:00:00 noon of January 1, 2000 in GPS time", "seconds"),
        ("spacecraft_id", "2nd", "Spacecraft", "char"),
        ("test_mass_id", "3rd", "Test mass to whose housing the vector points", "char"),
        ("mag", "4th", "Length of the vector", "m"),
        ("cosx", "5th", "Direction cosine of the vector with the x axis of its frame", "n/a"),
        ("cosy", "6th", "Direction cosine of the vector with the y axis of its frame", "n/a"),
        ("cosz", "7th", "Direction cosine of the vector with the z axis of its frame", "n/a"),
        ("qualflg", "8th", "Quality: 00000000 where the solutions agree, 00000001 where they do not", "n/a"),
    ];
    for (name, column, long_name, unit) in columns {
        let _ = writeln!(
            text,
            "    - {name}:\n        comment: {column} column\n        long_name: {}\n        units: {unit}",
            quoted(long_name)
        );
    }
    text += "# End of YAML header\n";
    let flag = if product.result.verdict.as_deref() == Some("agree") { "00000000" } else { "00000001" };
    for (test_mass, Offset { value_m: [x, y, z], .. }) in &offsets {
        let length = x.hypot(y.hypot(*z));
        let _ = writeln!(
            text,
            "{} {} {test_mass} {length:.12e} {:.15e} {:.15e} {:.15e} {flag}",
            epoch_s(product.result.epoch_ns),
            global.platform,
            x / length,
            y / length,
            z / length
        );
    }
    Ok(text)
}

/// What a VCM1B file of many days must say, as its format has one vector for all of them.
const OF_MANY_DAYS: &str = "the vectors hold at epoch_of_values; before it they differ by the rates, where there are any, \
                            and by the steps at events, which `dragfree at TIME` and --format csv tell";

struct Offset<'a> {
    value_m: [f64; 3],
    sigma_m: [f64; 3],
    frame: String,
    /// Rates of the three components, of a calibration of many days.
    rate: Option<[&'a Coefficient; 3]>,
}

/// Vectors whose three components, `EFFECT.TESTMASS.x|y|z` in metres, are in the adopted solution, by test mass.
fn offsets(product: &Product) -> BTreeMap<String, Offset<'_>> {
    let mut parts: BTreeMap<(String, String), [Option<&Coefficient>; 3]> = BTreeMap::new();
    for c in product.result.adopted().into_iter().filter(|c| c.unit == "m" && c.value.is_finite()) {
        let names: Vec<&str> = c.name.split('.').collect();
        let axis = names.last().and_then(|axis| ["x", "y", "z"].iter().position(|a| a == axis));
        if let ([effect, test_mass, _], Some(axis)) = (names.as_slice(), axis) {
            parts.entry(((*effect).to_owned(), (*test_mass).to_owned())).or_default()[axis] = Some(c);
        }
    }
    let whole = |((_, test_mass), [x, y, z]): ((String, String), [Option<&Coefficient>; 3])| {
        let (x, y, z) = (x?, y?, z?);
        let [rate_x, rate_y, rate_z] = [x, y, z].map(|c| rate_of(product, &c.name));
        let offset = Offset {
            rate: rate_x.zip(rate_y).zip(rate_z).map(|((x, y), z)| [x, y, z]),
            value_m: [x.value, y.value, z.value],
            sigma_m: [x.sigma, y.sigma, z.sigma],
            frame: x.frame.clone(),
        };
        Some((test_mass, offset))
    };
    parts.into_iter().filter_map(whole).collect()
}
