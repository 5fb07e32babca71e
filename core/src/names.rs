//! The macro `names!`.

/// Implements `ALL`, `name`, `Display` and the conversion to `&'static str` for an enum from a table of
/// names.
#[macro_export]
macro_rules! names {
    ($type:ty: $($variant:ident $name:literal,)*) => {
        #[allow(dead_code, unreachable_pub, reason = "private enums have names too, and not every list is used")]
        impl $type {
            /// Every variant, in the order of the table of names.
            pub const ALL: [Self; [$($name),*].len()] = [$(Self::$variant),*];

            /// The name.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $name,)* }
            }
        }

        impl From<$type> for &'static str {
            fn from(value: $type) -> Self {
                value.name()
            }
        }

        impl core::fmt::Display for $type {
            fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}
pub(crate) use names;
