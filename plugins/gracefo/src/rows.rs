//! The rows of a GRACE-FO Level-1 text file: from bytes to time-ordered SI columns. Nothing in here panics, whatever
//! the bytes are, and nothing is dropped without being counted.

use std::io::BufRead;

use crate::header::{END_OF_HEADER, Header, MAX_HEADER_BYTES, Presence};
use crate::product::{Product, Quantity};
use crate::{Level1Error, Window};

/// Unix seconds of 2000-01-01T12:00:00, the epoch of the mission's time tags. Both scales are labelled alike, so the
/// times that come out are Unix-like nanoseconds of GPS time (Level 1B) or of the receiver's clock (Level 1A).
pub const EPOCH_UNIX_S: i64 = 946_728_000;

/// Time tags beyond the year 2126 are damage; the bound also keeps the nanoseconds inside an `i64`.
const MAX_SECONDS: i64 = 4_000_000_000;

/// Rows of the mission are below 600 bytes; a longer line is damage and is skipped without being kept.
const MAX_LINE_BYTES: usize = 1 << 14;

/// The mission writes 1e33 for "no value".
const NO_VALUE: f64 = 1e33;

/// What was found and what was lost.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Rows kept.
    pub rows: u64,
    /// Lines below the header.
    pub lines: u64,
    /// Rows that the header promised, where that is not the number of lines.
    pub promised: Option<u64>,
    /// Lines that are no row of this product, and the number of the first of them.
    pub garbage: u64,
    /// Line number, from 1, of the first garbage line.
    pub first_garbage_line: Option<u64>,
    /// 1 if the file ends inside a line or cannot be read to its end.
    pub truncated: u64,
    /// Values that stand for "no value"; they become NaN.
    pub fill_values: u64,
    /// Rows earlier than a row before them; they are sorted in.
    pub out_of_order: u64,
    /// Rows of a time that was there before; the first stays.
    pub duplicates: u64,
    /// Rows of another spacecraft, instrument or time scale than the file should hold.
    pub foreign: u64,
    /// Rows whose quality flag says that the time tag is not synchronised; dropped.
    pub untimed: u64,
    /// Rows outside the window; dropped.
    pub outside_window: u64,
}

/// Rows of one instrument, strictly increasing in time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rows {
    /// Nanoseconds since 1970, see [`EPOCH_UNIX_S`].
    pub time_ns: Vec<i64>,
    /// One vector per column of the product, SI, NaN where there is no value.
    pub columns: Vec<Vec<f64>>,
}

/// A file that was read.
#[derive(Clone, Debug, PartialEq)]
pub struct Parsed {
    /// One per table of the product.
    pub tables: Vec<Rows>,
    /// What was found and lost.
    pub counts: Counts,
}

/// Reads a file of `product` and keeps the rows of `spacecraft` (`C` or `D`) inside `window`.
///
/// # Errors
/// [`Level1Error`] when the header is no header of this product. Damage below the header is counted instead.
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
    /// What goes into a report, each under its name. Rows outside the window are no loss.
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

/// Gives neighbouring quaternions of one rotation one sign. `last` carries the sign over from an earlier file.
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

/// Sorts by time where needed and drops all but the first row of a time.
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
    /// The input ends, or fails, inside this line.
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

    /// Puts the next line, without its end, into `bytes`; of a line that is too long, the beginning.
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

/// What a place in a row is for.
#[derive(Clone, Copy, Debug)]
enum Field {
    GpsTime,
    Seconds,
    Microseconds,
    /// `time_ref` or `GRACEFO_id`: MAG1A's rows have them the other way round than its header says, so that either
    /// may stand in either place.
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
                // Microseconds in every product read here, also in MAG1A, whose header says nanoseconds: its rows
                // stand at 100000 and 600000, and there are 172,800 of them in a day.
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

    /// Reads one row into `values`.
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

/// Decimal seconds without the rounding of a float: at 7e8 s an f64 has a grain of 0.1 µs.
fn decimal_seconds(word: &str) -> Option<i64> {
    let Some((whole, fraction)) = word.split_once('.') else { return whole_seconds(word) };
    if fraction.len() > 18 || !fraction.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    let nanoseconds: String = fraction.chars().chain("000000000".chars()).take(9).collect();
    Some(whole_seconds(whole)? + nanoseconds.parse::<i64>().ok()?)
}

/// A flag, most significant bit first.
fn bits(word: &str) -> Option<u32> {
    u32::from_str_radix(word, 2).ok().filter(|_| !word.starts_with('+'))
}
