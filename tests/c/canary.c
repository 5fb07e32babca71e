/* Two deliberate errors. tests/c/run.sh fails if a sanitizer does not find them. */
#include "check.h"

int main(void) {
#ifdef CANARY_leak
    const entire_gaussian_lobe lobe = {0.5f, 0.1f, 0.1f};
    entire_transfer_function *tf = NULL;
    OK(entire_transfer_function_from_lobes(&lobe, 1, &tf));
    tf = NULL;
#endif
#ifdef CANARY_overflow
    entire_transfer_function *tf = toy_transfer_function();
    float *rgba = malloc(100 * sizeof *rgba);
    CHECK(rgba != NULL);
    OK(entire_transfer_function_table(tf, rgba, 4 * ENTIRE_TABLE_ENTRIES)); /* `rgba` has only 100 floats */
    free(rgba);
    entire_transfer_function_free(tf);
#endif
    return 0;
}
