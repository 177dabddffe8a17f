//! Rows of a GRACE-FO Level-1 text file: from bytes to time-ordered SI columns. Never panics, whatever the bytes, and
//! counts everything that it drops.

use std::io::BufRead;

use crate::header::{END_OF_HEADER, Header, MAX_HEADER_BYTES, Presence};
use crate::product::{Product, Quantity};
use crate::{Level1Error, Window};

/// Unix seconds of 2000-01-01T12:00:00, the epoch of the time tags. Output times are Unix-like nanoseconds of GPS time
/// (Level 1B) or of the receiver's clock (Level 1A).
pub const EPOCH_UNIX_S: i64 = 946_728_000;

/// Maximum time tag, in the year 2126; it keeps the nanoseconds within an `i64`.
const MAX_SECONDS: i64 = 4_000_000_000;

/// Maximum line length; rows of the mission are below 600 bytes, longer lines are skipped.
const MAX_LINE_BYTES: usize = 1 << 14;

/// Value that means no value.
const NO_VALUE: f64 = 1e33;

/// Counts of what was read and lost.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Rows kept.
    pub rows: u64,
    /// Lines below the header.
    pub lines: u64,
    /// Number of rows in the header, if it differs from the number of lines.
    pub promised: Option<u64>,
    /// Unreadable lines.
    pub garbage: u64,
    /// Line number, from 1, of the first garbage line.
    pub first_garbage_line: Option<u64>,
    /// 1 if the file ends inside a line or cannot be read to its end.
    pub truncated: u64,
    /// Missing values; they become NaN.
    pub fill_values: u64,
    /// Rows earlier than a previous row; sorted in.
    pub out_of_order: u64,
    /// Rows with a repeated time; the first is kept.
    pub duplicates: u64,
    /// Rows of another spacecraft, instrument or time scale; dropped.
    pub foreign: u64,
    /// Rows whose quality flag marks the time tag as not synchronised; dropped.
    pub untimed: u64,
    /// Rows outside the window; dropped.
    pub outside_window: u64,
}

/// Rows of one instrument, strictly increasing in time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rows {
    /// Nanoseconds since 1970, see [`EPOCH_UNIX_S`].
    pub time_ns: Vec<i64>,
    /// Values per column of the product, SI; NaN if missing.
    pub columns: Vec<Vec<f64>>,
}

/// A parsed file.
#[derive(Clone, Debug, PartialEq)]
pub struct Parsed {
    /// Rows per table of the product.
    pub tables: Vec<Rows>,
    /// Counts.
    pub counts: Counts,
}

/// Parses a file of `product`; keeps the rows of `spacecraft` (`C` or `D`) inside `window`.
///
/// # Errors
/// [`Level1Error`]: invalid header. Damage below the header is counted instead.
pub fn parse(
    reader: &mut (impl BufRead + ?Sized),
    product: &Product,
    spacecraft: char,
    window: Window,
) -> Result<Parsed, Level1Error> {
    let mut lines = Lines::new(reader);
    let header = Header::parse(&header_text(&mut lines)?)?;
    if !header.platform.ends_with(spacecraft) {
        return Err(Level1Error::Platform { found: header.platform, wanted: spacecraft });
    }
    let layout = Layout::new(&header, product, spacecraft)?;
    let mut counts = Counts::default();
    let mut tables =
        vec![Rows { time_ns: Vec::new(), columns: vec![Vec::new(); product.columns.len()] }; product.tables().len()];
    let mut values = vec![f64::NAN; product.columns.len()];
    loop {
        match lines.next() {
            Line::End => break,
            Line::Cut => {
                counts.truncated = 1;
                break;
            }
            Line::Whole => counts.lines += 1,
        }
        match layout.row(&lines.bytes, &mut values, &mut counts.fill_values) {
            Row::Garbage => {
                counts.garbage += 1;
                counts.first_garbage_line.get_or_insert(lines.number);
            }
            Row::Foreign => counts.foreign += 1,
            Row::Untimed => counts.untimed += 1,
            Row::Good { time_ns, .. } if !window.contains(time_ns) => counts.outside_window += 1,
            Row::Good { time_ns, table } => {
                counts.rows += 1;
                tables[table].time_ns.push(time_ns);
                for (column, value) in tables[table].columns.iter_mut().zip(&values) {
                    column.push(*value);
                }
            }
        }
    }
    counts.promised = header.num_records.filter(|n| *n != counts.lines);
    for rows in &mut tables {
        order(rows, &mut counts);
    }
    Ok(Parsed { tables, counts })
}

impl Counts {
    /// Counts for the report, with names. Rows outside the window are no loss.
    pub(crate) fn each(&self) -> [(&'static str, u64); 8] {
        [
            ("header_count_wrong", u64::from(self.promised.is_some())),
            ("garbage_lines", self.garbage),
            ("files_truncated", self.truncated),
            ("fill_values", self.fill_values),
            ("rows_out_of_order", self.out_of_order),
            ("rows_duplicate", self.duplicates),
            ("rows_foreign", self.foreign),
            ("rows_untimed", self.untimed),
        ]
    }
}

/// Makes the sign of consecutive quaternions continuous. `last` carries the sign over from an earlier file.
pub fn align_quaternions(rows: &mut Rows, first: usize, last: &mut Option<[f64; 4]>) {
    for k in 0..rows.time_ns.len() {
        let mut q = [0, 1, 2, 3].map(|i| rows.columns[first + i][k]);
        if q.iter().any(|x| !x.is_finite()) {
            continue;
        }
        let flipped = last.is_some_and(|p| p.iter().zip(&q).map(|(a, b)| a * b).sum::<f64>() < 0.0);
        if flipped {
            q = q.map(|x| -x);
            for i in 0..4 {
                rows.columns[first + i][k] = q[i];
            }
        }
        *last = Some(q);
    }
}

/// Sorts by time and drops all but the first row of a time.
pub(crate) fn order(rows: &mut Rows, counts: &mut Counts) {
    let mut latest = i64::MIN;
    let mut late = 0;
    for t in &rows.time_ns {
        late += u64::from(*t < latest);
        latest = latest.max(*t);
    }
    counts.out_of_order += late;
    let mut index: Vec<usize> = (0..rows.time_ns.len()).collect();
    if late > 0 {
        index.sort_by_key(|i| rows.time_ns[*i]);
    }
    index.dedup_by_key(|i| rows.time_ns[*i]);
    let repeated = (rows.time_ns.len() - index.len()) as u64;
    if late == 0 && repeated == 0 {
        return;
    }
    counts.duplicates += repeated;
    counts.rows -= repeated;
    rows.time_ns = index.iter().map(|i| rows.time_ns[*i]).collect();
    for column in &mut rows.columns {
        *column = index.iter().map(|i| column[*i]).collect();
    }
}

enum Line {
    Whole,
    /// The input ends or fails inside this line.
    Cut,
    End,
}

struct Lines<'a, R: ?Sized> {
    reader: &'a mut R,
    bytes: Vec<u8>,
    number: u64,
}

impl<'a, R: BufRead + ?Sized> Lines<'a, R> {
    fn new(reader: &'a mut R) -> Self {
        Self { reader, bytes: Vec::new(), number: 0 }
    }

    /// Reads the next line, without its end, into `bytes`; of an overlong line the beginning.
    fn next(&mut self) -> Line {
        self.bytes.clear();
        self.number += 1;
        loop {
            let Ok(chunk) = self.reader.fill_buf() else { return Line::Cut };
            if chunk.is_empty() {
                return if self.bytes.is_empty() { Line::End } else { Line::Cut };
            }
            let end = chunk.iter().position(|b| *b == b'\n');
            let taken = end.unwrap_or(chunk.len());
            let room = (MAX_LINE_BYTES + 1).saturating_sub(self.bytes.len());
            self.bytes.extend_from_slice(&chunk[..taken.min(room)]);
            self.reader.consume(taken + usize::from(end.is_some()));
            if end.is_some() {
                return Line::Whole;
            }
        }
    }
}

fn header_text<R: BufRead + ?Sized>(lines: &mut Lines<'_, R>) -> Result<String, Level1Error> {
    let mut text = String::new();
    while let Line::Whole = lines.next() {
        let line = String::from_utf8_lossy(&lines.bytes);
        if line.trim_end() == END_OF_HEADER {
            return Ok(text);
        }
        if text.len() + line.len() > MAX_HEADER_BYTES {
            break;
        }
        text.push_str(line.trim_end_matches('\r'));
        text.push('\n');
    }
    Err(Level1Error::NoEndOfHeader)
}

/// Meaning of a position in a row.
#[derive(Clone, Copy, Debug)]
enum Field {
    GpsTime,
    Seconds,
    Microseconds,
    /// `time_ref` or `GRACEFO_id`. MAG1A's rows swap them relative to the header, so either may stand in either
    /// position.
    Letter,
    Instrument,
    ProductFlag,
    Column {
        index: usize,
        scale: f64,
        offset: f64,
        fill: Option<f64>,
    },
    Flag {
        index: Option<usize>,
        untimed_mask: u32,
    },
    Skip,
}

enum Row {
    Good { time_ns: i64, table: usize },
    Foreign,
    Untimed,
    Garbage,
}

struct Layout<'a> {
    fields: Vec<(Field, Presence)>,
    instruments: &'a [u8],
    spacecraft: char,
}

impl<'a> Layout<'a> {
    fn new(header: &Header, product: &'a Product, spacecraft: char) -> Result<Self, Level1Error> {
        for column in product.columns {
            let (unit, ..) = column.quantity.units();
            let Some(variable) = header.index(column.variable).map(|i| &header.variables[i]) else {
                return Err(Level1Error::MissingVariable(column.variable));
            };
            if column.quantity != Quantity::Flag && variable.units != unit {
                return Err(Level1Error::Unit {
                    variable: column.variable,
                    found: variable.units.clone(),
                    wanted: unit,
                });
            }
        }
        let field = |v: &crate::header::Variable| {
            let index = product.columns.iter().position(|c| c.variable == v.name);
            let flag = index.is_none_or(|i| product.columns[i].quantity == Quantity::Flag);
            match (v.name.as_str(), index) {
                ("gps_time", _) => Field::GpsTime,
                ("rcvtime_intg" | "time_intg", _) => Field::Seconds,
                // Microseconds in every product, also in MAG1A, whose header says nanoseconds: its fractions are 100000
                // and 600000 in 172,800 rows a day.
                ("rcvtime_frac" | "time_frac", _) => Field::Microseconds,
                ("time_ref" | "GRACEFO_id", _) => Field::Letter,
                ("prod_flag", _) => Field::ProductFlag,
                ("qualflg", index) => Field::Flag { index, untimed_mask: header.untimed_mask },
                (name, _) if product.instrument.is_some_and(|(n, _)| n == name) => Field::Instrument,
                (_, Some(i)) if flag => Field::Flag { index: Some(i), untimed_mask: 0 },
                (_, Some(index)) => {
                    let (_, _, scale, offset) = product.columns[index].quantity.units();
                    Field::Column { index, scale, offset, fill: v.fill }
                }
                _ => Field::Skip,
            }
        };
        let fields: Vec<_> = header.variables.iter().map(|v| (field(v), v.presence)).collect();
        if !fields.iter().any(|(f, p)| matches!(f, Field::GpsTime | Field::Seconds) && *p == Presence::Always) {
            return Err(Level1Error::MissingVariable("gps_time or rcvtime_intg"));
        }
        Ok(Self { fields, instruments: product.instrument.map_or(&[], |(_, ids)| ids), spacecraft })
    }

    /// Parses one row into `values`.
    fn row(&self, bytes: &[u8], values: &mut [f64], fills: &mut u64) -> Row {
        self.fields_of(bytes, values, fills).unwrap_or(Row::Garbage)
    }

    fn fields_of(&self, bytes: &[u8], values: &mut [f64], fills: &mut u64) -> Option<Row> {
        if bytes.len() > MAX_LINE_BYTES {
            return None;
        }
        let mut words = std::str::from_utf8(bytes).ok()?.split_ascii_whitespace();
        values.fill(f64::NAN);
        let (mut product_flag, mut time_ns, mut table) = (0_u32, None, 0);
        let (mut foreign, mut untimed, mut missing) = (false, false, 0);
        for (field, presence) in &self.fields {
            match presence {
                Presence::Always => {}
                Presence::Bit(bit) if product_flag >> bit & 1 == 1 => {}
                Presence::Bit(_) | Presence::Never => continue,
            }
            let word = words.next()?;
            match *field {
                Field::GpsTime => time_ns = Some(decimal_seconds(word)?),
                Field::Seconds => time_ns = Some(whole_seconds(word)?),
                Field::Microseconds => {
                    let us: i64 = word.parse().ok().filter(|us| (0..1_000_000).contains(us))?;
                    time_ns = time_ns.map(|t| t + us * 1000);
                }
                Field::Letter => match word {
                    "R" | "G" => {}
                    "C" | "D" => foreign |= !word.starts_with(self.spacecraft),
                    _ => return None,
                },
                Field::Instrument => {
                    let id: u8 = word.parse().ok()?;
                    match self.instruments.iter().position(|i| *i == id) {
                        Some(i) => table = i,
                        None => foreign = true,
                    }
                }
                Field::ProductFlag => product_flag = bits(word)?,
                Field::Flag { index, untimed_mask } => {
                    let flag = bits(word)?;
                    untimed |= flag & untimed_mask != 0;
                    if let Some(i) = index {
                        values[i] = f64::from(flag);
                    }
                }
                Field::Column { index, scale, offset, fill } => {
                    let value: f64 = word.parse().ok()?;
                    if !value.is_finite() || value.abs() >= NO_VALUE || Some(value) == fill {
                        missing += 1;
                    } else {
                        values[index] = scale * value + offset;
                    }
                }
                Field::Skip => {}
            }
        }
        if words.next().is_some() {
            return None;
        }
        let time_ns = time_ns?;
        if foreign {
            return Some(Row::Foreign);
        }
        if untimed {
            return Some(Row::Untimed);
        }
        *fills += missing;
        Some(Row::Good { time_ns, table })
    }
}

fn whole_seconds(word: &str) -> Option<i64> {
    let s: i64 = word.parse().ok().filter(|s| (0..=MAX_SECONDS).contains(s))?;
    Some((EPOCH_UNIX_S + s) * 1_000_000_000)
}

/// Parses decimal seconds without the rounding of an f64, 0.1 µs at 7e8 s.
fn decimal_seconds(word: &str) -> Option<i64> {
    let Some((whole, fraction)) = word.split_once('.') else { return whole_seconds(word) };
    if fraction.len() > 18 || !fraction.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    let nanoseconds: String = fraction.chars().chain("000000000".chars()).take(9).collect();
    Some(whole_seconds(whole)? + nanoseconds.parse::<i64>().ok()?)
}

/// Parses a flag, most significant bit first.
fn bits(word: &str) -> Option<u32> {
    u32::from_str_radix(word, 2).ok().filter(|_| !word.starts_with('+'))
}
