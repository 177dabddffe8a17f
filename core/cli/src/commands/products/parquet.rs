//! Coefficients of a product as Parquet: the rows and columns of the CSV, with types, missing numbers as null.

use crate::failure::Failure;
use dragfree_archive::product::Product;
use parquet::basic::{LogicalType, Repetition, Type as Physical};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::Type;
use std::sync::Arc;

/// A column of the table.
enum Column {
    Text(&'static str, Vec<String>),
    Number(&'static str, Vec<f64>),
}

/// The file.
pub(super) fn coefficients(product: &Product) -> Result<Vec<u8>, Failure> {
    let all = &product.result.coefficients;
    let of = |text: &str| vec![text.to_owned(); all.len()];
    let columns = [
        Column::Text("product", of(product.id())),
        Column::Text("day", of(&product.header.non_standard_attributes.day)),
        Column::Text("spacecraft", of(&product.header.global_attributes.platform)),
        Column::Text("solution", all.iter().map(|c| c.solution.clone()).collect()),
        Column::Text("coefficient", all.iter().map(|c| c.name.clone()).collect()),
        Column::Number("value", all.iter().map(|c| c.value).collect()),
        Column::Number("sigma", all.iter().map(|c| c.sigma).collect()),
        Column::Text("unit", all.iter().map(|c| c.unit.clone()).collect()),
        Column::Text("frame", all.iter().map(|c| c.frame.clone()).collect()),
    ];
    file(&columns).map_err(|error| format!("the table cannot be written as Parquet: {error}").into())
}

fn file(columns: &[Column]) -> Result<Vec<u8>, ParquetError> {
    let field = |column: &Column| {
        let field = match column {
            Column::Text(name, _) => Type::primitive_type_builder(name, Physical::BYTE_ARRAY)
                .with_repetition(Repetition::REQUIRED)
                .with_logical_type(Some(LogicalType::String)),
            Column::Number(name, _) => {
                Type::primitive_type_builder(name, Physical::DOUBLE).with_repetition(Repetition::OPTIONAL)
            }
        };
        field.build().map(Arc::new)
    };
    let fields = columns.iter().map(field).collect::<Result<Vec<_>, _>>()?;
    let schema = Type::group_type_builder("coefficients").with_fields(fields).build()?;
    let properties = WriterProperties::builder().set_created_by(crate::commands::SOFTWARE.to_owned()).build();
    let mut writer = SerializedFileWriter::new(Vec::new(), Arc::new(schema), Arc::new(properties))?;
    let mut group = writer.next_row_group()?;
    for column in columns {
        let Some(mut open) = group.next_column()? else { break };
        match column {
            Column::Text(_, values) => {
                let values: Vec<ByteArray> = values.iter().map(|text| text.as_str().into()).collect();
                open.typed::<ByteArrayType>().write_batch(&values, None, None)?;
            }
            Column::Number(_, values) => {
                let there: Vec<f64> = values.iter().copied().filter(|x| x.is_finite()).collect();
                let levels: Vec<i16> = values.iter().map(|x| i16::from(x.is_finite())).collect();
                open.typed::<DoubleType>().write_batch(&there, Some(&levels), None)?;
            }
        }
        open.close()?;
    }
    group.close()?;
    writer.into_inner()
}

#[cfg(test)]
mod tests {
    use super::*;
    use parquet::file::reader::{FileReader as _, SerializedFileReader};
    use parquet::record::Field;
    use std::io::Write as _;

    #[test]
    fn a_missing_number_is_null() {
        let columns =
            [Column::Text("unit", vec!["m".into(), "µm".into()]), Column::Number("sigma", vec![f64::NAN, 2.5e-7])];
        let mut open = tempfile::tempfile().expect("a file");
        open.write_all(&file(&columns).expect("Parquet")).expect("written");
        let reader = SerializedFileReader::new(open).expect("Parquet");
        let rows: Vec<Vec<Field>> = reader
            .get_row_iter(None)
            .expect("rows")
            .map(|row| row.expect("a row").into_columns().into_iter().map(|(_, field)| field).collect())
            .collect();
        assert_eq!(rows[0], [Field::Str("m".into()), Field::Null]);
        assert_eq!(rows[1], [Field::Str("µm".into()), Field::Double(2.5e-7)]);
    }
}
