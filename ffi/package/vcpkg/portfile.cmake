# The port of this source tree: `vcpkg install entire --overlay-ports=ffi/package/vcpkg`. Needs cargo on the path.
get_filename_component(SOURCE_PATH "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
set(ENV{CARGO_TARGET_DIR} "${CURRENT_BUILDTREES_DIR}/target")
vcpkg_execute_required_process(
    COMMAND "${SOURCE_PATH}/ffi/package/install.sh" --prefix "${CURRENT_PACKAGES_DIR}"
    WORKING_DIRECTORY "${SOURCE_PATH}"
    LOGNAME install)
# A release build also serves programs that are built for debugging.
set(VCPKG_BUILD_TYPE release)
set(VCPKG_POLICY_MISMATCHED_NUMBER_OF_BINARIES enabled)
# The CMake package finds the library relative to itself, so it stays where install.sh puts it.
set(VCPKG_POLICY_SKIP_MISPLACED_CMAKE_FILES_CHECK enabled)
set(VCPKG_POLICY_SKIP_LIB_CMAKE_MERGE_CHECK enabled)
file(REMOVE_RECURSE "${CURRENT_PACKAGES_DIR}/share/licenses")
vcpkg_fixup_pkgconfig()
vcpkg_install_copyright(FILE_LIST "${SOURCE_PATH}/LICENSE-MIT" "${SOURCE_PATH}/LICENSE-APACHE")
