# SPDX-License-Identifier: Apache-2.0
# Links against an older glibc than this system's, so that the libraries load on systems of its age. The package
# ziglang has the symbols of every glibc; its linker stubs take the place of this system's glibc.
file(WRITE ${CMAKE_BINARY_DIR}/glibc/empty.c "int blitzgs_empty;\n")
execute_process(
  COMMAND
    ${CMAKE_COMMAND} -E env ZIG_GLOBAL_CACHE_DIR=${CMAKE_BINARY_DIR}/glibc/zig
    ZIG_LOCAL_CACHE_DIR=${CMAKE_BINARY_DIR}/glibc/zig ${Python3_EXECUTABLE} -m ziglang cc -target
    x86_64-linux-gnu.${BLITZGS_GLIBC} -shared empty.c -o empty.so
  WORKING_DIRECTORY ${CMAKE_BINARY_DIR}/glibc
  COMMAND_ERROR_IS_FATAL ANY
)
file(GLOB glibc_stubs ${CMAKE_BINARY_DIR}/glibc/zig/o/*/lib*.so.*)
foreach(stub IN LISTS glibc_stubs)
  get_filename_component(name ${stub} NAME_WE)
  file(COPY_FILE ${stub} ${CMAKE_BINARY_DIR}/glibc/${name}.so)
endforeach()
# As in the system's libc.so: some functions are linked into every library.
execute_process(
  COMMAND ${CMAKE_CXX_COMPILER} -print-file-name=libc_nonshared.a
  OUTPUT_VARIABLE libc_nonshared
  OUTPUT_STRIP_TRAILING_WHITESPACE
)
set(glibc_folder ${CMAKE_BINARY_DIR}/glibc)
file(RENAME ${glibc_folder}/libc.so ${glibc_folder}/libc_stub.so)
file(
  WRITE ${glibc_folder}/libc.so
  "GROUP ( ${glibc_folder}/libc_stub.so ${libc_nonshared} AS_NEEDED ( ${glibc_folder}/libld.so ) )\n"
)
target_link_options(blitzgs_flags INTERFACE -L${glibc_folder})
target_link_libraries(blitzgs_flags INTERFACE -lpthread -ldl -lrt)

# Headers of newer systems ask glibc 2.32 whether the process has one thread only; older ones cannot tell.
file(
  WRITE ${glibc_folder}/single_threaded.cpp
  "extern \"C\" __attribute__((visibility(\"hidden\"))) const char __libc_single_threaded = 0;\n"
)
target_sources(blitzgs_flags INTERFACE ${glibc_folder}/single_threaded.cpp)
